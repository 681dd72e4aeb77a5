"""Several videos of one place: one stream with cuts, one map."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from geogs.cli import main as cli
from geogs.config import Config, DepthConfig, InputConfig, LoopConfig, MappingConfig, TrackingConfig
from geogs.errors import InputError
from geogs.evaluation.trajectory_errors import evaluate_trajectory
from geogs.io.sources.frame_source import PAUSE
from geogs.io.sources.sniff import open_source
from geogs.slam import Slam
from geogs.types import Frame, Trajectory
from tracking_scenes import CAMERA, frames, sideways

pytestmark = pytest.mark.system

# A map of the least: its poses and its keyframes are what is asked for.
QUICK = Config(
    tracking=TrackingConfig(init_keyframes=5),
    mapping=MappingConfig(
        render_long_edge=64, iterations=1, pose_iterations=0,
        depth=DepthConfig(planes=32),
    ),
)  # fmt: skip


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
        assert [f.left for f in read] == [2, 1, 0, 3, 2, 1, 0]
        times = [f.timestamp for f in read]
        assert times == sorted(times)
        assert times[3] == pytest.approx(times[2] + PAUSE)
        assert [int(f.image[0, 0, 0]) for f in read] == [0, 10, 20, 0, 10, 20, 30]
    assert source.length == len(source) == len(list(source)) == 7
    assert open_source(paths, replace(config, stride=3)).fps == pytest.approx(10)
    assert [(s.name, s.first_frame) for s in source.spans] == [("a", 0), ("b", 3)]


def test_other_cameras_are_refused(tmp_path):
    small, large = folder(tmp_path / "a", 2), folder(tmp_path / "b", 2, width=80)
    with pytest.raises(InputError, match="one camera mode"):
        open_source([small, large], InputConfig())
    with pytest.raises(InputError, match="Nothing to read"):
        open_source([], InputConfig())


@pytest.mark.usefixtures("no_report")
def test_two_videos_of_a_place_make_one_map(small_room, tmp_path):
    parts = [tmp_path / "a", tmp_path / "b"]
    pictures = sorted((small_room / "results").glob("frame*"))
    k = json.loads((small_room / "cam_params.json").read_text())["camera"]
    # The second begins where the first has been, and ends elsewhere.
    for part, chosen in zip(parts, (pictures[:18], pictures[9:27]), strict=True):
        part.mkdir()
        for picture in chosen:
            shutil.copy(picture, part)
    intrinsics = ",".join(str(k[name]) for name in ("fx", "fy", "cx", "cy"))
    argv = [
        "run", *map(str, parts), "-o", str(tmp_path / "out"), "--intrinsics", intrinsics,
        "--preset", "fast", "--tracking.init-keyframes", "6", "--mapping.render-long-edge", "64",
        "--mapping.iterations", "1", "--mapping.final-iterations", "5", "--device", "cpu",
        "--mapping.depth.planes", "32",
    ]  # fmt: skip
    assert cli.main(argv) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["frames"] == 36
    assert [v["name"] for v in summary["videos"]] == ["a", "b"]
    assert summary["videos"][1]["first_frame"] == 18
    assert [s["fate"] for s in summary["segments"]] == ["world"]
    lost = sum(round(30 * (last - first)) + 1 for first, last in summary["lost_spans"])
    assert lost <= 2


@pytest.mark.long
def test_all_keyframes_are_adjusted_on_the_way_where_asked_for():
    path = sideways(30)
    reference = Trajectory(np.arange(30) / 30, np.stack(path), np.ones(30, dtype=bool))

    def run(every: int) -> tuple[int, float]:
        slam = Slam(CAMERA, replace(QUICK, loop=LoopConfig(global_ba_every=every)), device="cpu")
        for frame in frames(path):
            slam.process(frame)
        slam.end_stream()
        return slam.world.adjusted, evaluate_trajectory(slam.trajectory(), reference).ate_rmse_cm

    assert run(0)[0] == 0
    adjusted, error = run(6)
    assert adjusted >= 6
    assert error < 0.3


@pytest.mark.long
def test_the_map_shows_the_largest_of_videos_that_have_nothing_in_common():
    """The first is short; the second shows a mirrored room."""
    first, second = frames(sideways(10)), frames(sideways(28))
    stream = first + [
        Frame(10 + k, f.timestamp + 2, np.ascontiguousarray(f.image[::-1]), k == 0)
        for k, f in enumerate(second)
    ]
    slam = Slam(CAMERA, QUICK, device="cpu")
    for frame in stream:
        slam.process(frame)
    slam.end_stream()
    fates = [s["fate"] for s in slam.statistics()["segments"]]
    assert fates == ["apart", "world"]
    trajectory = slam.trajectory()
    assert trajectory.tracked.tolist() == [False] * 10 + [True] * 28
    assert list(slam.executor.mapper.views) == slam.segments.keyframe_ids
    assert slam.executor.mapper.table.mapped == slam.segments.keyframe_ids
    assert len(slam.snapshot()) > 200
