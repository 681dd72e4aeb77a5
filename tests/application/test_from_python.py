"""Everything a command does can be done from Python, with the same result, and without a word."""

import json
import re
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import geogs
from geogs.application.interrupt import Interruption
from geogs.application.run import opened_for, run
from geogs.application.run_settings import RunSettings
from geogs.camera.distortion import RESAMPLING, lens_maps
from geogs.cli import main as cli
from geogs.cli.terminal.speech import NOT_JUDGED, closing_message
from geogs.config import InputConfig
from geogs.io.pose_files import read_tum_trajectory
from geogs.pose_estimate import PoseEstimate
from geogs.types import FoundLens
from lenses import with_lens
from posed_scene import vertices

pytestmark = pytest.mark.system

FRAMES = 22
RUN = [
    "--stop", str(FRAMES), "--tracking.init-keyframes", "6",
    "--mapping.render-long-edge", "64", "--mapping.iterations", "2",
    "--mapping.pose-iterations", "0", "--mapping.final-iterations", "10",
    "--mapping.no-final-depth", "--mapping.when", "online",
]  # fmt: skip
POSED = [
    "--mapping.render-long-edge", "96", "--mapping.disk.stride", "2", "--search.least-steps", "20",
    "--search.steps-per-view", "1", "--search.no-repeat", "--stride", "6",
]  # fmt: skip


def run_config() -> geogs.Config:
    config = geogs.Config()
    mapping = replace(
        config.mapping, render_long_edge=64, iterations=2, pose_iterations=0, final_iterations=10,
        final_depth=False, when="online",
    )  # fmt: skip
    return replace(
        config,
        input=replace(config.input, stop=FRAMES),
        tracking=replace(config.tracking, init_keyframes=6),
        mapping=mapping,
    )


def posed_config() -> geogs.ReconstructConfig:
    config = geogs.ReconstructConfig()
    disk = replace(config.mapping.disk, stride=2)
    return replace(
        config,
        input=replace(config.input, stride=6),
        search=replace(config.search, least_steps=20, steps_per_view=1, repeat=False),
        mapping=replace(config.mapping, render_long_edge=96, disk=disk),
    )


def require_same(folder: Path, other: Path) -> None:
    """That two results are the same to the last byte."""
    for name in ("trajectory.tum", "keyframes.tum", "mesh.ply", "splats.ply", "config.yaml"):
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name
    disks, twin = (geogs.load_map(f / "map.safetensors") for f in (folder, other))
    assert (disks.position == twin.position).all()


def test_a_run_frame_by_frame_is_that_of_the_command(small_room, tmp_path, capfd):
    source = geogs.open_source(small_room, run_config().input)
    source = geogs.application.self_calibrated(source, run_config())
    slam = geogs.Slam(source.camera, run_config(), device="cpu")
    for frame in source:
        slam.process(frame)
    slam.finish()
    result = geogs.application.Result(slam, source)
    assert not list(tmp_path.iterdir())
    geogs.application.write_results(tmp_path / "own", result)
    assert capfd.readouterr() == ("", "")
    assert result.mesh is not None
    assert len(result.mesh.faces) > 300
    argv = [str(small_room), "-o", str(tmp_path / "out"), *RUN, "--device", "cpu"]
    assert cli.main(["run", *argv]) in (0, 3)
    said = capfd.readouterr()
    verdict, counts, where, page = said.out.splitlines()
    assert verdict == result.verdict.sentence
    assert f"{FRAMES} frames in " in counts
    assert f"{len(result.mesh.faces)} triangles" in counts
    assert where.startswith(f"Results are in {tmp_path}/out/: trajectory.tum, mesh.ply")
    assert page == f"Open {tmp_path}/out/report/index.html in a browser."
    phases = re.findall(r"^([a-z ]+): \d+", said.err, re.MULTILINE)
    final = ["bundle adjustment", "map refinement", "mesh", "report"]
    assert phases == ["calibration", "frames", *final]
    assert f"Stages: {', '.join(phases)}." in said.err
    require_same(tmp_path / "own", tmp_path / "out")
    seconds = json.loads((tmp_path / "out" / "summary.json").read_text())["seconds"]
    assert seconds["reading"] > 0
    rates = json.loads((tmp_path / "own" / "summary.json").read_text())["frames_per_second"]
    online = slam.stopwatch.until_stream_end
    assert rates["until_stream_end"] == pytest.approx(FRAMES / online, rel=1e-3)
    assert slam.stopwatch.seconds["tracking"] < online < slam.stopwatch.total


class Impatient(geogs.application.RunProgress):
    """Remembers what it was told, and stops after some frames."""

    def __init__(self, stop: Interruption, frames: int) -> None:
        self.stop, self.frames = stop, frames
        self.said: list[str] = []
        self.seen = 0

    def expect(self, frames: int | None) -> None:
        assert frames == FRAMES

    def frame(self, status: PoseEstimate) -> None:
        self.seen = status.frames
        self.stop.requested = status.frames == self.frames

    def write(self, text: str) -> None:
        self.said.append(text)


@pytest.mark.usefixtures("no_report")
def test_a_whole_run_is_one_call_that_can_be_followed_and_stopped(small_room, tmp_path, capfd):
    stop = Interruption()
    progress = Impatient(stop, 18)
    settings = RunSettings(
        (small_room,), run_config(), tmp_path / "out", "cpu", checkpoint_every=900.0
    )
    result = run(settings, progress, stop)
    assert progress.seen == 18
    stopped = "Stopping early; keeping what there is. Press Ctrl-C again to quit."
    assert progress.said[-1] == stopped
    assert progress.said[0].startswith("Input: small-room, ")
    assert result.verdict is None
    assert closing_message(result, 3.0)[0] == NOT_JUDGED
    assert result.folder == tmp_path / "out"
    assert result.can_resume
    assert result.is_interrupted
    assert len(result.trajectory.timestamps) == 18
    assert len(read_tum_trajectory(tmp_path / "out" / "trajectory.tum").timestamps) == 18
    assert capfd.readouterr() == ("", "")


@pytest.mark.usefixtures("no_report")
@pytest.mark.long
def test_a_reconstruction_is_that_of_the_command_and_writes_nothing(
    small_room, tmp_path, capfd, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    result = geogs.reconstruct(small_room, posed_config(), device="cpu")
    assert capfd.readouterr() == ("", "")
    mesh, disks = result.mesh, result.map
    assert not list(tmp_path.iterdir())
    assert mesh is not None
    given = np.loadtxt(small_room / "traj.txt").reshape(-1, 4, 4)[::6]
    assert np.abs(result.trajectory.T_wc - given).max() < 1e-9
    assert cli.main(["reconstruct", str(small_room), "-o", "out", *POSED, "--device", "cpu"]) == 0
    assert np.array_equal(vertices(tmp_path / "out" / "mesh.ply"), mesh.vertices)
    assert (geogs.load_map("out/map.safetensors").position == disks.position).all()
    opened = geogs.open_posed_source(small_room, posed_config().input)
    assert opened.length == len(given)
    geogs.application.write_results("own", result)
    require_same(tmp_path / "own", tmp_path / "out")


@pytest.mark.long
def test_a_run_in_one_call_is_that_of_the_command_too(small_room, tmp_path, capfd, no_report):
    result = geogs.run(small_room, run_config(), tmp_path / "out", "cpu")
    assert capfd.readouterr() == ("", "")
    assert result.folder == tmp_path / "out"
    assert repr(result) == f"Result('{tmp_path}/out': {FRAMES} frames, {len(result.map)} disks)"
    saved = geogs.load_result(result.folder)
    assert np.array_equal(saved.mesh.vertices, result.mesh.vertices)
    T_cw = np.linalg.inv(result.keyframes.T_wc[1])
    assert np.array_equal(result.render(T_cw).depth, saved.render(T_cw).depth)
    assert (saved.render(T_cw).depth > 0).mean() > 0.5


LIGHT = """
import sys
import geogs
heavy = ("torch", "numpy", "numba", "cv2", "scipy", "matplotlib", "av", "rich", "tyro")
print([name for name in heavy if name in sys.modules])
"""


def test_the_package_loads_nothing_before_it_is_used():
    done = subprocess.run([sys.executable, "-c", LIGHT], capture_output=True, text=True)
    assert done.stdout == "[]\n", done.stderr
    assert all(hasattr(geogs, name) for name in geogs.__all__)
    for module in (geogs, geogs.application):
        assert set(dir(module)) == set(module.__all__)
        with pytest.raises(AttributeError, match="no attribute nothing"):
            _ = module.nothing


@pytest.mark.usefixtures("no_report")
def test_a_lens_that_was_found_is_said_and_written(small_room, tmp_path, capfd, monkeypatch):
    found = FoundLens(0.1, -0.05, 0.002, 0.003)

    def bent(matches, *_, before=None, **__) -> FoundLens | None:
        if before is not None:
            return None
        matches.graph.see_by(matches.camera.moved(0.0, 0.1, -0.05))
        return found

    patch = "geogs.loop.global_bundle.correct_lens"
    folder = tmp_path / "out"
    argv = [str(small_room), *RUN, "--device", "cpu", "--no-fallback"]
    with monkeypatch.context() as patched:
        patched.setattr(patch, bent)
        assert cli.main(["run", *argv, "-o", str(folder)]) in (0, 3)
    (said,) = re.findall(r"Lens re-estimated: .*", capfd.readouterr().err)
    assert "k1 0.1000 +- 0.0020, k2 -0.0500 +- 0.0030. Reuse it" in said
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["lens"] == asdict(found)
    document = json.loads((folder / "intrinsics.json").read_text())
    assert document["source"]["distortion"] == pytest.approx([0.1, -0.05, 0.0, 0.0], abs=1e-9)
    assert document["source"]["fx"] == document["fx"]
    given = re.findall(r"--intrinsics (\S+) ", said)[0]
    again = geogs.open_source(small_room, InputConfig(intrinsics=given))
    assert again.calibration.distortion == pytest.approx((0.1, -0.05, 0.0, 0.0))
    plain = geogs.open_source(small_room)
    saved = geogs.load_result(folder)
    time = saved.keyframes[3].timestamp
    shown = next(f for f in plain if f.timestamp == pytest.approx(time))
    camera = plain.camera
    maps = lens_maps(camera, with_lens(camera, (0.1, -0.05, 0.0, 0.0)))
    straight = cv2.remap(shown.image, *maps, RESAMPLING, borderMode=cv2.BORDER_REPLICATE)
    off = np.abs(saved.image(3).astype(float) - straight).mean()
    assert off < 0.3 * np.abs(shown.image.astype(float) - straight).mean()
    going_on = RunSettings((small_room,), map=folder)
    opened = opened_for(going_on, saved)
    assert opened.camera.fx == pytest.approx(saved.camera.fx, rel=1e-9)
    image = next(iter(opened)).image
    assert np.abs(image.astype(float) - next(iter(plain)).image).mean() > 0.5
