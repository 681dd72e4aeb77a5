"""Several videos of one place: one stream with cuts, one map."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from geogs.config import Config, InputConfig, LoopConfig, TrackingConfig
from geogs.errors import InputError
from geogs.evaluation.trajectory import evaluate_trajectory
from geogs.io.sources.several import PAUSE
from geogs.io.sources.sniff import open_source
from geogs.slam import Slam
from geogs.types import Frame, Trajectory
from tracking_scenes import CAMERA, frames, sideways


def folder(path: Path, count: int, width: int = 64, name: str = "frame") -> Path:
    path.mkdir()
    for k in range(count):
        image = np.full((48, width, 3), 10 * k, np.uint8)
        cv2.imwrite(str(path / f"{name}{k:04d}.png"), image)
    return path


def test_frames_are_numbered_and_timed_through(tmp_path):
    config = InputConfig(intrinsics="50,50,31.5,23.5")
    paths = [folder(tmp_path / "a", 3), folder(tmp_path / "b", 4)]
    source = open_source(paths, config)
    for _ in range(2):  # a source can be read again
        read = list(source)
        assert [f.index for f in read] == list(range(7))
        assert [f.follows_cut for f in read] == [False] * 3 + [True] + [False] * 3
        times = [f.timestamp for f in read]
        assert times == sorted(times)
        assert times[3] == pytest.approx(times[2] + PAUSE)
        assert [int(f.image[0, 0, 0]) for f in read] == [0, 10, 20, 0, 10, 20, 30]
    assert source.length == 7
    assert [(s.name, s.first_frame) for s in source.spans] == [("a", 0), ("b", 3)]


def test_other_cameras_are_refused(tmp_path):
    small, large = folder(tmp_path / "a", 2), folder(tmp_path / "b", 2, width=80)
    with pytest.raises(InputError, match="one camera mode"):
        open_source([small, large], InputConfig())
    with pytest.raises(InputError, match="Nothing to read"):
        open_source([], InputConfig())


def test_two_videos_of_a_place_make_one_map(tmp_path):
    room, parts = tmp_path / "room", [tmp_path / "a", tmp_path / "b"]
    geogs = [sys.executable, "-m", "geogs.cli.main"]
    size = ["--frames", "40", "--width", "256", "--height", "192"]
    subprocess.run([*geogs, "synth", str(room), *size], check=True, capture_output=True)
    pictures = sorted((room / "results").glob("frame*"))
    k = json.loads((room / "cam_params.json").read_text())["camera"]
    # The second begins where the first has been, and ends elsewhere.
    for part, chosen in zip(parts, (pictures[:26], pictures[16:]), strict=True):
        part.mkdir()
        for picture in chosen:
            shutil.copy(picture, part)
    intrinsics = ",".join(str(k[name]) for name in ("fx", "fy", "cx", "cy"))
    done = subprocess.run(
        [
            *geogs, "run", *map(str, parts), "-o", str(tmp_path / "out"),
            "--intrinsics", intrinsics, "--preset", "fast", "--mapping.render-long-edge", "160",
            "--mapping.iterations", "2", "--mapping.final-iterations", "20",
        ],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["frames"] == 50
    assert [v["name"] for v in summary["videos"]] == ["a", "b"]
    assert summary["videos"][1]["first_frame"] == 26
    assert [s["fate"] for s in summary["segments"]] == ["world"]
    lost = sum(round(30 * (last - first)) + 1 for first, last in summary["lost_spans"])
    assert lost <= 2


def test_all_keyframes_are_adjusted_on_the_way_where_asked_for():
    tracking = TrackingConfig(init_keyframes=5)

    path = sideways(36)
    reference = Trajectory(np.arange(36) / 30, np.stack(path), np.ones(36, dtype=bool))

    def run(every: int) -> tuple[int, float]:
        slam = Slam(CAMERA, Config(tracking=tracking, loop=LoopConfig(global_ba_every=every)))
        for frame in frames(path):
            slam.process(frame)
        slam.end_stream()
        return slam.adjusted, evaluate_trajectory(slam.trajectory(), reference).ate_rmse_cm

    assert run(0)[0] == 0
    adjusted, error = run(6)
    assert adjusted >= 6
    assert error < 0.3


def test_the_map_shows_the_largest_of_videos_that_have_nothing_in_common():
    """The first is short; the second shows a mirrored room."""
    first, second = frames(sideways(10)), frames(sideways(34))
    stream = first + [
        Frame(10 + k, f.timestamp + 2, np.ascontiguousarray(f.image[::-1]), k == 0)
        for k, f in enumerate(second)
    ]
    tracking = TrackingConfig(init_keyframes=5)
    slam = Slam(CAMERA, Config(tracking=tracking))
    for frame in stream:
        slam.process(frame)
    slam.end_stream()
    fates = [s["fate"] for s in slam.particulars()["segments"]]
    assert fates == ["apart", "world"]
    trajectory = slam.trajectory()
    assert trajectory.tracked.tolist() == [False] * 10 + [True] * 34
    assert slam.mapper.keyframe_ids == slam.segments.keyframe_ids
    assert slam.mapper.mapped == slam.segments.keyframe_ids
    assert len(slam.snapshot()) > 500
