"""What tracking lost is placed by structure from motion, where that is better, and else kept."""

import functools
import json
import pickle
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs.application import remedy
from geogs.application.calibrate import self_calibrated
from geogs.application.checkpoints.checkpoint import checkpoint_folder, write_checkpoint
from geogs.application.checkpoints.run_state import RunMetadata, run_state
from geogs.application.results.result import Result
from geogs.application.results.verdict import Verdict
from geogs.application.run_settings import RunSettings
from geogs.application.structure_from_motion import fallback, offline
from geogs.application.structure_from_motion.completion import LostFrames
from geogs.application.structure_from_motion.fallback import (
    TrackedOrPlaced,
    has_wrong_joint,
    impossible,
    is_better,
    is_wanted,
    rotations_agree,
)
from geogs.application.structure_from_motion.offline import PlacedOffline
from geogs.application.structure_from_motion.photos import PlacedVideo
from geogs.cli.main import main
from geogs.cli.options import record
from geogs.cli.run import parse
from geogs.config import Config, preset, preset_of
from geogs.extras import install_command
from geogs.io.pose_files import read_tum_trajectory
from geogs.io.sources.frame_source import Source
from geogs.io.sources.sniff import open_source
from geogs.slam import Slam
from geogs.types import FoundFrames, Trajectory
from io_samples import write_image
from posed_layouts import Room, render_room
from posed_scene import BRIEF

GOOD = Verdict(True, "Reliable.", 0.0, 0.0, 0.01, 0.1, 0.02)
LOST = replace(GOOD, is_reliable=False, lost=0.3)
FLAT = replace(GOOD, is_reliable=False, depth=0.29)
STABILISED = replace(GOOD, is_reliable=False, lens_varies=True)
TURNED = Verdict(False, "Rotation only.", 0.0, 1.0, np.inf, np.inf, np.inf)
FRAMES = 16


def test_another_way_is_wanted_where_frames_are_missing_or_nothing_is_to_be_relied_on():
    assert not is_wanted(GOOD)
    assert not is_wanted(replace(GOOD, lost=0.08))
    for judged in (None, LOST, TURNED, replace(GOOD, lost=0.12), replace(GOOD, is_reliable=False)):
        assert is_wanted(judged)
    assert not is_wanted(FLAT)  # all frames have a place, and fewer matches know no depth better
    assert not is_wanted(STABILISED)  # nor is one lens for all frames right
    assert is_wanted(replace(FLAT, lost=0.06))
    assert is_wanted(replace(STABILISED, lost=0.06))


@pytest.mark.parametrize(
    ("placed", "tracked", "better"),
    [
        (GOOD, None, True),
        (GOOD, LOST, True),
        (GOOD, TURNED, True),
        (GOOD, replace(GOOD, lost=0.12), True),
        (GOOD, replace(GOOD, lost=0.03), False),  # hardly more, and tracking is to be relied on
        (GOOD, replace(GOOD, is_reliable=False, position=0.1), True),  # as many, better known
        (GOOD, FLAT, False),  # as many
        (GOOD, replace(FLAT, lost=0.06), True),  # more
        (replace(GOOD, lost=0.4), LOST, False),  # fewer
        (replace(LOST, lost=0.28), LOST, False),  # hardly more
        (replace(GOOD, position=0.08), LOST, False),  # more, but nobody knows where
        (replace(GOOD, depth=0.5), LOST, False),
        (replace(LOST, depth=0.35), replace(LOST, lost=0.7, depth=0.38), True),  # as well, more
        (replace(LOST, depth=0.4), replace(LOST, lost=0.7, depth=0.38), False),
        (replace(LOST, depth=0.6), TURNED, False),  # no shape
        (replace(GOOD, position=np.nan), LOST, False),
    ],
)
def test_the_better_of_two_worlds(placed, tracked, better):
    assert is_better(placed, tracked) is better


@pytest.mark.parametrize(
    ("settings", "source", "reason"),
    [
        ({}, {}, ""),
        ({}, {"is_live": True}, "cannot be read again"),
        ({"map": Path("old")}, {}, "saved map"),
        ({"scale_from": "height:1.6"}, {}, "no metric scale"),
        ({}, {"uses_depth": True}, "no metric scale"),
        ({}, {"uses_poses": True}, "no metric scale"),
    ],
)
def test_what_cannot_be_placed_once_more(settings, source, reason):
    flags = {"is_live": False, "uses_depth": False, "uses_poses": False} | source
    kind = type("Some", (Source,), flags)
    found = impossible(RunSettings(**settings), kind.__new__(kind))
    assert reason in found
    assert bool(reason) == bool(found)


def test_the_map_is_made_by_the_preset_of_the_run():
    for name in ("default", "fast", "accurate", "paper"):
        assert preset_of(replace(preset(name), seed=7)) == name
        own = replace(preset(name).mapping, render_long_edge=111)  # the rest is the preset's still
        assert preset_of(replace(Config(), mapping=own)) == name
    assert preset_of(preset("default", on_gpu=True)) == "default"


@functools.cache
def filmed() -> Room:
    """What all tests here see; rendered once in a process. Nobody may change it."""
    return render_room(FRAMES, 3, 160, 120)


def write_video(folder: Path) -> list[str]:
    """The room as a folder of images, and what a run of it is told."""
    room = filmed()
    for k, image in enumerate(room.images):
        write_image(folder / f"{k:03d}.png", image)
    c = room.camera
    return [
        "run", str(folder), "--device", "cpu", "--intrinsics", f"{c.fx},{c.fy},{c.cx},{c.cy}",
        "--mapping.render-long-edge", "64", "--mapping.final-iterations", "5",
        "--tracking.init-keyframes", "6", "--mapping.depth.planes", "32",
    ]  # fmt: skip


@pytest.fixture
def _lost(monkeypatch) -> None:
    """Tracking is taken to have lost too many of the frames."""
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(offline, "reconstruct_preset", lambda _: BRIEF)
    monkeypatch.setattr(fallback, "is_wanted", lambda _: True)


@pytest.fixture(scope="session")
def tracked(once) -> Path:
    """The checkpoint of a run whose frames have been tracked; all else is still to come."""

    def track(folder: Path) -> None:
        settings = record(RunSettings, parse(write_video(folder.parent / "video")[1:]))
        source = self_calibrated(open_source(settings.source, settings.config.input))
        slam = Slam(source.camera, settings.config, "cpu", defers_map=True)
        for frame in source:
            slam.process(frame)
        slam.end_stream()
        metadata = RunMetadata(
            settings.absolute(), "cpu", source.fingerprint(), None, shutter=source.shutter
        )
        state = run_state(metadata, slam, source)
        write_checkpoint(checkpoint_folder(folder), state)

    return once("tracked-video", track)


@pytest.fixture
def ended(_lost, tracked, tmp_path, no_report) -> Callable[[], dict]:
    """Goes on with the tracked video to the end of its run; the summary."""

    def go_on(name: str = "out") -> dict:
        shutil.copytree(tracked, tmp_path / name)
        code = main(["run", "--resume", str(tmp_path / name)])
        summary = json.loads((tmp_path / name / "summary.json").read_text())
        assert code in ((130,) if summary["interrupted"] else (0, 3))
        return summary

    return go_on


@pytest.fixture
def _placed_once(once, monkeypatch) -> None:
    """Where the frames of the video were taken is found once, by whoever asks first."""
    place = offline.place_frames

    def found(*args: object) -> PlacedVideo:
        kept = once("placed-video", lambda file: file.write_bytes(pickle.dumps(place(*args))))
        return pickle.loads(kept.read_bytes())

    monkeypatch.setattr(offline, "place_frames", found)


@pytest.mark.system
@pytest.mark.usefixtures("_placed_once")
def test_placed_frames_are_taken_where_they_are_better(ended, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(fallback, "is_better", lambda *_: True)
    summary = ended()
    assert summary["offline"]["sharp_frames"] == FRAMES
    assert "eliable" in summary["offline"]["instead_of"]
    assert summary["seconds"]["tracking"] > 0
    assert summary["seconds"]["structure from motion"] > 0
    assert summary["interrupted"] is False
    said = capfd.readouterr().err
    assert "Trying structure from motion;" in said
    assert "Its result is mapped" in said
    placed = read_tum_trajectory(tmp_path / "out" / "trajectory.tum").T_wc[:, :3, 3]
    steps, truth = (
        np.linalg.norm(np.diff(p, axis=0), axis=1) for p in (placed, filmed().T_wc[:, :3, 3])
    )
    np.testing.assert_allclose(steps / steps.sum(), truth / truth.sum(), atol=0.01)
    assert not (tmp_path / "out" / "checkpoint").exists()


@pytest.mark.system
@pytest.mark.long
def test_what_was_tracked_stays_where_nothing_better_comes_of_it(
    ended, tmp_path, monkeypatch, capfd
):
    def fails(*_: object) -> None:
        raise RuntimeError("Of 16 sharp frames no three tell where they were taken.")

    for module in (fallback, remedy):
        monkeypatch.setattr(module, "has_pycolmap", lambda: False)
    monkeypatch.setattr(remedy, "is_wanted", lambda _: True)
    plain = ended("plain")
    last = capfd.readouterr().out.splitlines()[-1]
    assert f"{install_command('photos')} && geogs run" in last
    assert "--sfm locates the frames by structure from motion." in last
    monkeypatch.setattr(fallback, "has_pycolmap", lambda: True)
    monkeypatch.setattr(PlacedOffline, "place", fails)
    summary = ended()
    assert "the tracked result is kept" in capfd.readouterr().err
    assert "offline" not in summary
    assert summary["verdict"] == plain["verdict"]
    one, other = (tmp_path / name / "trajectory.tum" for name in ("plain", "out"))
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.system
@pytest.mark.usefixtures("_lost", "no_report")
@pytest.mark.long
def test_frames_that_are_found_about_the_keyframes_have_a_place(tmp_path, monkeypatch):
    command = write_video(tmp_path / "video")
    write_image(tmp_path / "video" / "009.png", np.zeros_like(filmed().images[9]))
    asked, judged = list[LostFrames](), Result.verdict.func

    def relied_on(self: Result) -> Verdict:
        return replace(judged(self), is_reliable=True)

    def finds(lost: LostFrames, *_: object) -> FoundFrames:
        asked.append(lost)
        count = len(lost.numbers)
        poses = np.tile(next(iter(lost.known.values())), (count, 1, 1))
        times = np.array([lost._times[k] for k in lost.numbers])
        return FoundFrames(tuple(lost.numbers), times, poses, *np.full((2, count), 1e-3))

    monkeypatch.setattr(LostFrames, "search", finds)
    monkeypatch.setattr(fallback, "is_wanted", lambda _: False)
    monkeypatch.setattr(Result, "verdict", property(relied_on))
    assert main([*command, "-o", str(tmp_path / "out")]) in (0, 3)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert 9 in asked[0].numbers
    assert summary["verdict"]["lost"] == 0
    assert len(read_tum_trajectory(tmp_path / "out" / "trajectory.tum").timestamps) == FRAMES


@pytest.mark.system
@pytest.mark.usefixtures("_placed_once")
def test_one_lens_for_all_is_not_relied_on_where_tracking_saw_it_change(ended, monkeypatch):
    judged = TrackedOrPlaced._judged
    monkeypatch.setattr(fallback, "is_better", lambda *_: True)
    monkeypatch.setattr(
        TrackedOrPlaced, "_judged", lambda *a: replace(judged(*a), lens_varies=True, lost=0.05)
    )
    summary = ended()
    assert "offline" in summary
    assert "the lens changes from image to image" in summary["verdict"]["sentence"]


@pytest.mark.system
@pytest.mark.usefixtures("_placed_once")
def test_what_turns_the_camera_otherwise_is_not_taken(ended, monkeypatch, capfd):
    judged = PlacedOffline.judged

    def turned(self: PlacedOffline) -> Verdict:
        """As if it had taken every second step for none."""
        T = self.trajectory.T_wc.copy()
        T[1::2, :3, :3] = T[::2, :3, :3] @ np.diag([1.0, -1.0, -1.0])
        self.trajectory = replace(self.trajectory, T_wc=T)
        return judged(self)

    monkeypatch.setattr(fallback, "has_pycolmap", lambda: True)
    monkeypatch.setattr(fallback, "is_better", lambda *_: True)
    monkeypatch.setattr(PlacedOffline, "judged", turned)
    summary = ended()
    assert "Their rotations disagree" in capfd.readouterr().err
    assert "offline" not in summary


@pytest.mark.system
@pytest.mark.parametrize("stage", ["place", pytest.param("map", marks=pytest.mark.long)])
def test_ctrl_c_keeps_what_was_tracked(ended, tmp_path, monkeypatch, capfd, stage):
    def is_stopped(self: PlacedOffline, driver: object, *_: object) -> None:
        signal.raise_signal(signal.SIGINT)
        driver.report("features", 0.5)

    monkeypatch.setattr(fallback, "is_better", lambda *_: True)
    monkeypatch.setattr(PlacedOffline, stage, is_stopped)
    summary = ended()
    assert "keeping what there is" in capfd.readouterr().err
    assert "offline" not in summary
    assert summary["interrupted"] is True
    assert summary["disks"] > 0
    assert len(read_tum_trajectory(tmp_path / "out" / "trajectory.tum").timestamps) == FRAMES


def walk(factor: float = 1.0, noise: float = 0.0, frames: int = 40) -> Trajectory:
    """Two degrees from frame to frame, times a factor, and noise in degrees, around odd axes."""
    g = np.random.default_rng(0)
    steps = g.normal((0, 2, 0), 0.5, (frames, 3))
    R = Rotation.identity()
    T = np.tile(np.eye(4), (frames, 1, 1))
    for n in range(frames):
        R = R * Rotation.from_rotvec(factor * steps[n], degrees=True)
        wrong = Rotation.from_rotvec(noise * g.normal(0, 1, 3), degrees=True)
        T[n, :3, :3] = (R * wrong).as_matrix()
        T[n, :3, 3] = g.normal(0, 1, 3)
    return Trajectory(np.arange(frames) / 30, T, np.ones(frames, bool))


@pytest.mark.parametrize(
    ("other", "alike"),
    [
        (walk(), True),
        (walk(noise=0.2), True),
        (walk(factor=1.1), True),  # another focal length
        (walk(factor=0.5), False),
        (walk(factor=-1.0), False),
        (walk(noise=5.0), False),
    ],
)
def test_other_turns_are_noticed_whatever_the_world(other: Trajectory, alike: bool):
    S = Rotation.from_euler("xyz", [40, 20, 10], degrees=True).as_matrix()
    turned = other.T_wc.copy()
    turned[:, :3] = S @ turned[:, :3]
    assert rotations_agree(walk(), Trajectory(other.timestamps, turned, other.tracked)) is alike


def test_only_frames_count_that_both_place():
    other = walk(factor=0.5)
    few = np.arange(40) < 14
    assert rotations_agree(walk(), Trajectory(other.timestamps, other.T_wc, few))
    half = np.arange(40) % 2 == 0
    some = Trajectory(other.timestamps[half], other.T_wc[half], other.tracked[half])
    assert not rotations_agree(walk(), some)


@pytest.mark.parametrize(("turn", "is_broken"), [(25.0, False), (35.0, True)])
def test_a_single_joint_of_two_parts_that_turns_otherwise_is_noticed(turn, is_broken):
    R = Rotation.from_euler("y", turn, degrees=True).as_matrix()
    other = walk()
    other.T_wc[20:, :3] = R @ other.T_wc[20:, :3]
    some = np.arange(40) % 3 == 0
    sharp = Trajectory(other.timestamps[some], other.T_wc[some], other.tracked[some])
    assert has_wrong_joint(walk(), sharp) is is_broken
    assert rotations_agree(walk(), other)
    lost = np.arange(40) != 19  # what tracking says of a turn during which it was lost is no truth
    assert not has_wrong_joint(Trajectory(other.timestamps, walk().T_wc, lost), sharp)
