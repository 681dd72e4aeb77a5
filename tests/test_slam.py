"""The whole system through the command line, on rendered frames with known truth."""

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from called_commands import done
from data_set_layouts import asl_truth, sensor_yaml
from geogs.application.result_settings import RemeshSettings
from geogs.application.results.revise import mesh_settings, remesh
from geogs.application.results.saved_result import load_result
from geogs.cli import main as cli
from geogs.evaluation.surfaces.surface import read_surface
from geogs.evaluation.trajectory_errors import evaluate_trajectory
from geogs.io.pose_files import read_poses, read_tum_trajectory
from geogs.io.sources.calibration_files import read_calibration
from geogs.io.writers.map_file import load_map
from geogs.mesh.mesh_file import read_mesh
from geogs.slam import Slam
from geogs.types import Frame, Trajectory
from json_schema import faults

pytestmark = pytest.mark.system

GEOGS = [sys.executable, "-m", "geogs.cli.main"]
SCHEMA = Path(__file__).parents[1] / "docs" / "summary.schema.json"
FRAMES = 44
# Small enough for a test, all stages on.
QUICK = [
    "--mapping.render-long-edge", "128", "--mapping.iterations", "4",
    "--mapping.pose-iterations", "1", "--mapping.final-iterations", "50",
    "--tracking.init-keyframes", "8", "--device", "cpu",
]  # fmt: skip
# All stages on, for 128 x 96 pixels, and no more than a start.
SMALL_FRAMES = 28
SMALL = [
    "--mapping.render-long-edge", "96", "--mapping.iterations", "2",
    "--mapping.pose-iterations", "1", "--mapping.final-iterations", "10",
    "--tracking.init-keyframes", "6", "--mapping.depth.planes", "48", "--device", "cpu",
    "--no-strict",
]  # fmt: skip


def geogs(*arguments: object, timeout: float = 1800) -> subprocess.CompletedProcess[str]:
    command = [*GEOGS, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout)


@pytest.fixture(scope="session")
def result(room, once) -> Path:
    """What ``geogs run`` leaves of the start of a room, 256 x 192."""

    def run(folder: Path) -> None:
        done = geogs("run", room, "--stop", FRAMES, "-o", folder, *QUICK)
        assert done.returncode == 0, done.stderr

    return once("slam", run)


@pytest.fixture(scope="session")
def small_result(small_room, once) -> Path:
    """What it leaves of smaller images, with all that can be asked for."""

    def run(folder: Path) -> None:
        done(
            "run", small_room, "--stop", SMALL_FRAMES, "-o", folder, "--online-results",
            "--depth-mesh", *SMALL,
        )  # fmt: skip

    return once("small-slam", run)


@pytest.mark.long
def test_a_run_reaches_its_accuracy(room, result, tmp_path):
    out = shutil.copytree(result, tmp_path / "out")
    assert cli.main(["eval", str(out), "--gt", str(room), "--no-plots"]) == 0
    scores = json.loads((out / "eval.json").read_text())
    assert scores["trajectory"]["ate_rmse_cm"] < 0.3
    assert scores["trajectory"]["pairs"] == FRAMES
    surface = scores["reconstruction"]
    assert surface["accuracy_cm"] < 4.0
    assert surface["completeness_ratio"] > 65.0
    disks = load_map(result / "map.safetensors")
    assert disks.is_finite()
    assert 1000 < len(disks) < 30_000
    summary = json.loads((result / "summary.json").read_text())
    assert summary["peak_memory_bytes"] < 2e9
    said = summary["verdict"]
    assert said["is_reliable"]
    assert said["position"] < 0.02
    assert said["depth"] < 0.05
    scale = scores["trajectory"]["scale"]
    rows = (result / "trajectory_uncertainty.csv").read_text().splitlines()[1:]
    states = [row.split(",") for row in rows]
    assert [state for _, state, *_ in states] == ["tracked"] * FRAMES
    claimed = np.median([float(sigma) for _, _, sigma, *_ in states])
    assert 100 * scale * claimed > 0.3 * scores["trajectory"]["ate_rmse_cm"]


def test_a_small_run_is_near_the_truth(small_room, small_result, tmp_path):
    out = shutil.copytree(small_result, tmp_path / "out")
    assert cli.main(["eval", str(out), "--gt", str(small_room), "--no-plots"]) == 0
    scores = json.loads((out / "eval.json").read_text())
    assert scores["trajectory"]["pairs"] == SMALL_FRAMES
    assert scores["trajectory"]["ate_rmse_cm"] < 0.4
    surface = scores["reconstruction"]
    assert surface["accuracy_cm"] < 8.0
    assert surface["completeness_ratio"] > 20.0
    said = json.loads((small_result / "summary.json").read_text())["verdict"]
    assert said["is_reliable"]
    assert said["lost"] == 0
    assert said["position"] < 0.05


@pytest.mark.long
@pytest.mark.usefixtures("no_report")
def test_a_sequence_of_euroc_runs_as_it_lies_on_disk(small_room, tmp_path):
    """The truth is the body's, brought to the camera; the result is compared by the clock."""
    mav0 = tmp_path / "euroc" / "V1_01_easy" / "mav0"
    (mav0 / "cam0" / "data").mkdir(parents=True)
    stamps = 1403715273262142976 + 50_000_000 * np.arange(SMALL_FRAMES)
    for k, stamp in enumerate(stamps):
        image = cv2.imread(str(small_room / "results" / f"frame{k:06d}.jpg"))
        cv2.imwrite(str(mav0 / "cam0" / "data" / f"{stamp}.png"), image)
    listing = "".join(f"{t},{t}.png\n" for t in stamps)
    (mav0 / "cam0" / "data.csv").write_text("#timestamp [ns],filename\n" + listing)
    camera = read_calibration(small_room / "cam_params.json").fit(128, 96)
    K = camera.fx, camera.fy, camera.cx, camera.cy
    sensor = sensor_yaml("radial-tangential", "0.0, 0.0, 0.0, 0.0", (128, 96), K)
    (mav0 / "cam0" / "sensor.yaml").write_text(sensor)
    poses = read_poses(small_room / "traj.txt").T_wc[:SMALL_FRAMES]
    asl_truth(mav0 / "state_groundtruth_estimate0" / "data.csv", stamps, 9, poses)
    out = tmp_path / "out"
    assert cli.main(["run", str(mav0.parent), "-o", str(out), *SMALL]) == 0
    assert cli.main(["eval", str(out), "--gt", str(tmp_path / "euroc"), "--no-plots"]) == 0
    scores = json.loads((out / "eval.json").read_text())
    assert scores["trajectory"]["pairs"] == SMALL_FRAMES
    assert scores["trajectory"]["ate_rmse_cm"] < 0.6
    assert scores["trajectory"]["rotation_rmse_deg"] < 4.0  # the body is turned by some 70
    assert scores["doubts"] == []


def test_a_run_leaves_every_file(small_result):
    names = [
        "trajectory.tum", "keyframes.tum", "intrinsics.json", "mesh.ply", "splats.ply",
        "map.safetensors", "config.yaml", "summary.json", "trajectory_uncertainty.csv",
        "report/trajectory.png",
        "report/keyframes.png",
    ]  # fmt: skip
    assert [n for n in names if not (small_result / n).is_file()] == []
    trajectory = read_tum_trajectory(small_result / "trajectory.tum")
    assert np.allclose(np.diff(trajectory.timestamps), 1 / 30, atol=1e-6)
    disks = load_map(small_result / "map.safetensors")
    summary = json.loads((small_result / "summary.json").read_text())
    assert list(faults(summary, json.loads(SCHEMA.read_text()))) == []
    assert disks.is_finite()
    assert summary["disks"] == len(disks) > 300
    assert summary["frames"] == SMALL_FRAMES
    assert summary["lost_spans"] == []


def test_a_result_is_used_again(small_result, tmp_path):
    result = load_result(small_result)
    assert len(result.keyframes) == result.summary["keyframes"]
    assert all(k.image.shape[:2] == (result.camera.height, result.camera.width)
               for k in result.keyframes)  # fmt: skip
    path = remesh(
        RemeshSettings(small_result, mesh_settings(small_result), tmp_path / "m.ply", "cpu")
    )
    again = read_mesh(path)
    for name in ("vertices", "faces", "normals"):
        np.testing.assert_array_equal(getattr(result.mesh, name), getattr(again, name))
    difference = result.mesh.colours.astype(int) - again.colours
    assert np.abs(difference).mean() < 2.0


def test_the_online_result_and_the_depths_alone_are_written_too(small_result):
    online = read_tum_trajectory(small_result / "online" / "trajectory.tum")
    final = read_tum_trajectory(small_result / "trajectory.tum")
    assert len(online.timestamps) == len(final.timestamps) == SMALL_FRAMES
    assert 0 < np.abs(online.T_wc - final.T_wc).max() < 0.1
    seconds = json.loads((small_result / "summary.json").read_text())["seconds"]
    assert seconds["online results"] > 0
    assert seconds["depth fusion"] > 0
    assert seconds["total"] == pytest.approx(sum(seconds.values()) - seconds["total"], abs=0.1)
    keyframes = read_tum_trajectory(small_result / "online" / "keyframes.tum")
    assert 4 < len(keyframes.timestamps) < SMALL_FRAMES
    meshes = [read_surface(small_result / n / "mesh.ply") for n in ("online", "depth_fusion", ".")]
    assert all(len(mesh.faces) > 300 for mesh in meshes)
    assert len({len(mesh.faces) for mesh in meshes}) == 3


def test_the_papers_stage_lies_between_the_stream_and_the_refinement(small_result):
    online, adjusted, final = (
        read_tum_trajectory(small_result / name / "trajectory.tum")
        for name in ("online", "adjusted", ".")
    )
    assert np.abs(adjusted.T_wc - online.T_wc).max() > 0
    assert np.array_equal(adjusted.T_wc, final.T_wc)  # the refinement moves the map alone
    meshes = [read_surface(small_result / name / "mesh.ply") for name in ("adjusted", ".")]
    assert len({len(mesh.faces) for mesh in meshes}) == 2
    assert json.loads((small_result / "summary.json").read_text())["refined"]


@pytest.mark.long
@pytest.mark.usefixtures("no_report")
def test_ground_truth_is_never_read(small_room, small_result, tmp_path):
    """Without the truth beside the images the poses come out the same, bit for bit.

    Nor do the results that were asked for besides change anything.
    """
    bare = tmp_path / "bare"
    (bare / "results").mkdir(parents=True)
    shutil.copy(small_room / "cam_params.json", bare)
    for image in (small_room / "results").glob("frame*"):
        shutil.copy(image, bare / "results")
    assert run_small(bare, tmp_path / "out", "--mapping.when", "online") == 0
    again = (tmp_path / "out" / "trajectory.tum").read_bytes()
    assert again == (small_result / "trajectory.tum").read_bytes()
    disks, twin = (
        load_map(tmp_path / "out" / "map.safetensors"),
        load_map(small_result / "map.safetensors"),
    )
    assert (disks.position == twin.position).all()


def run_small(room: Path, out: Path, *options: str) -> int:
    """``geogs run`` in this process; its exit code."""
    stop = ["--stop", str(SMALL_FRAMES)]
    return cli.main(["run", str(room), "-o", str(out), *stop, *SMALL, *options])


def at_frame_24(monkeypatch, happens: Callable[[], object]) -> None:
    """Something happens when the frame of that index comes."""
    process = Slam.process

    def process_or_stop(self: Slam, frame: Frame) -> object:
        if frame.index == 24:
            happens()
        return process(self, frame)

    monkeypatch.setattr(Slam, "process", process_or_stop)


def full(*_: object, **__: object) -> None:
    raise torch.cuda.OutOfMemoryError("CUDA out of memory.")


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupting_keeps_what_there_is(number, small_room, tmp_path, monkeypatch, capsys):
    """And `geogs run … && next` does not go on: the exit code is the signal's."""
    at_frame_24(monkeypatch, lambda: signal.raise_signal(number))
    assert run_small(small_room, tmp_path) == 128 + number
    assert "Stopping early; keeping what there is." in capsys.readouterr().err
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["interrupted"] is True
    assert summary["frames"] == 25  # the one at hand is finished
    assert len(read_tum_trajectory(tmp_path / "trajectory.tum").timestamps) == 25
    assert len(load_map(tmp_path / "map.safetensors")) > 300


@pytest.mark.long
@pytest.mark.usefixtures("no_report")
def test_a_full_gpu_memory_keeps_what_there_is(small_room, tmp_path, monkeypatch, capsys):
    at_frame_24(monkeypatch, full)
    assert run_small(small_room, tmp_path) == 2
    said = capsys.readouterr().err
    assert "memory of the GPU was full after 24 frames" in said
    assert "Traceback" not in said
    assert len(read_tum_trajectory(tmp_path / "trajectory.tum").timestamps) == 24
    assert json.loads((tmp_path / "summary.json").read_text())["interrupted"] is True


@pytest.mark.long
@pytest.mark.usefixtures("no_report")
def test_a_gpu_that_is_full_in_the_final_stages_keeps_the_online_result(
    small_room, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("geogs.slam.global_bundle", full)
    assert run_small(small_room, tmp_path) == 2
    said = capsys.readouterr().err
    assert "no memory left for the final stages" in said
    assert "continues from the last checkpoint" in said  # the frames need not be tracked again
    assert len(read_tum_trajectory(tmp_path / "trajectory.tum").timestamps) == SMALL_FRAMES
    assert json.loads((tmp_path / "summary.json").read_text())["interrupted"] is True


def images(folder: Path, frames: list[np.ndarray]) -> Path:
    folder.mkdir()
    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"{i:04d}.png"), frame)
    return folder


def camera_of(room: Path) -> str:
    """Its intrinsics as an option."""
    camera = json.loads((room / "cam_params.json").read_text())["camera"]
    return ",".join(str(camera[k]) for k in ("fx", "fy", "cx", "cy"))


def noise(seed: int = 0, size: tuple[int, int] = (128, 96)) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    return cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)


def turned(degrees: float) -> np.ndarray:
    """The picture of a camera turned about its vertical axis, seeing a far panorama."""
    coarse = np.random.default_rng(1).integers(0, 255, (60, 120, 3), dtype=np.uint8)
    panorama = cv2.resize(coarse, (480, 240), interpolation=cv2.INTER_CUBIC)
    K = np.array([[100.0, 0, 63.5], [0, 100, 47.5], [0, 0, 1]])
    wide = np.array([[100.0, 0, 239.5], [0, 100, 119.5], [0, 0, 1]])
    R = cv2.Rodrigues(np.array([0.0, np.radians(degrees), 0.0]))[0]
    return cv2.warpPerspective(panorama, K @ R @ np.linalg.inv(wide), (128, 96))


CASES = {
    "one frame": ([noise()], "hardly moves"),
    "black frames": ([np.zeros((96, 128, 3), np.uint8)] * 12, "enough texture"),
    # Matched well enough to try a start.
    "unrelated frames": ([noise(i, (192, 144)) for i in range(7)], "show no parallax"),
}
TURNING = {
    "static video": ([noise()] * 12, "hardly moves"),
    "two frames": ([turned(0), turned(4)], "hardly moves"),
    "pure rotation": ([turned(1.4 * i - 14) for i in range(20)], "show no parallax"),
}


def some_long(names: Iterable[str], long: str) -> list:
    """Cases by name, one of which takes long."""
    return [pytest.param(n, marks=pytest.mark.long) if n == long else n for n in names]


@pytest.mark.parametrize("name", some_long(CASES, "unrelated frames"))
def test_hopeless_input_gets_one_sentence(name, tmp_path, capsys):
    frames, words = CASES[name]
    assert cli.main(run_on(frames, tmp_path)) == 2
    said = capsys.readouterr().err
    errors = [line for line in said.splitlines() if line.startswith("error:")]
    assert len(errors) == 1, said
    assert "Traceback" not in said
    assert words in errors[0]


def run_on(frames: list[np.ndarray], folder: Path) -> list[str]:
    """``geogs run`` on pictures of a camera of some focal length, which writes to ``out``."""
    height, width = frames[0].shape[:2]
    intrinsics = f"{0.8 * width},{0.8 * width},{width / 2 - 0.5},{height / 2 - 0.5}"
    source, out = images(folder / "images", frames), folder / "out"
    return ["run", str(source), "-o", str(out), "--intrinsics", intrinsics, *SMALL]


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize("name", some_long(TURNING, "pure rotation"))
def test_a_camera_that_does_not_move_leaves_orientations(name, tmp_path, capsys):
    frames, words = TURNING[name]
    assert cli.main(run_on(frames, tmp_path)) == 2
    told = capsys.readouterr()
    said = " ".join(told.out.split())
    assert "Rotation only: no shape." in said
    assert words in said
    end = told.err.splitlines()[-1]
    assert end.startswith(f"error: No mesh was made; the other files are in {tmp_path / 'out'}/. ")
    assert words in end
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert words in summary["not_started"]
    assert not summary["verdict"]["is_reliable"]
    assert not (tmp_path / "out" / "mesh.ply").exists()
    rows = (tmp_path / "out" / "trajectory_uncertainty.csv").read_text().splitlines()[1:]
    assert [row.split(",")[1] for row in rows] == ["orientation only"] * len(frames)


@pytest.mark.long
@pytest.mark.usefixtures("no_report")
def test_a_result_of_little_worth_says_so(small_room, tmp_path, capsys):
    """Frames that have nothing to do with each other after a good start."""
    files = sorted((small_room / "results").glob("frame*"))[:20]
    frames = [cv2.imread(str(f)) for f in files] + [noise(i) for i in range(20)]
    folder, out = images(tmp_path / "images", frames), tmp_path / "out"
    argv = ["run", str(folder), "-o", str(out), "--intrinsics", camera_of(small_room), *SMALL]
    assert cli.main([*argv, "--strict"]) == 3
    assert "not tracked" in capsys.readouterr().err
    ((first, last),) = json.loads((out / "summary.json").read_text())["lost_spans"]
    assert (round(30 * first), round(30 * last)) == (20, 39)


@pytest.mark.long
@pytest.mark.usefixtures("no_report")
def test_a_gap_of_black_frames_is_survived_and_reported(small_room, tmp_path):
    """Frames that show nothing are marked as lost; the camera is found again after them."""
    files = sorted((small_room / "results").glob("frame*"))[:34]
    frames = [cv2.imread(str(f)) for f in files]
    for i in range(22, 26):
        frames[i] = np.zeros_like(frames[i])
    folder = images(tmp_path / "images", frames)
    argv = ["run", str(folder), "-o", str(tmp_path / "out"), *SMALL]
    assert cli.main([*argv, "--intrinsics", camera_of(small_room)]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [[round(30 * t) for t in span] for span in summary["lost_spans"]] == [[22, 25]]
    estimate = read_tum_trajectory(tmp_path / "out" / "keyframes.tum")
    truth = np.loadtxt(small_room / "traj.txt").reshape(-1, 4, 4)
    reference = Trajectory(np.arange(60) / 30, truth, np.ones(60, dtype=bool))
    assert evaluate_trajectory(estimate, reference).ate_rmse_cm < 0.4
