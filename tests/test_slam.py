"""The whole system through the command line, on rendered frames with known truth."""

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from geogs.evaluation.surface import read_surface
from geogs.io.poses import read_tum_trajectory
from geogs.io.writers.native import load_map

pytestmark = pytest.mark.system

GEOGS = [sys.executable, "-m", "geogs.cli.main"]
FRAMES = 44
# Small enough for a test, all stages on.
QUICK = [
    "--mapping.render-long-edge", "160", "--mapping.iterations", "6",
    "--mapping.pose-iterations", "1", "--mapping.final-iterations", "60",
]  # fmt: skip


def geogs(*arguments: object, timeout: float = 400) -> subprocess.CompletedProcess[str]:
    command = [*GEOGS, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """The start of a synthetic room sequence, 256 x 192."""
    folder = tmp_path_factory.mktemp("room") / "room"
    done = geogs("synth", folder, "--frames", FRAMES, "--width", 256, "--height", 192)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def result(room, tmp_path_factory) -> Path:
    """What ``geogs run`` leaves of it, with all that can be asked for."""
    folder = tmp_path_factory.mktemp("result") / "out"
    done = geogs("run", room, "-o", folder, "--online-results", "--depth-mesh", *QUICK)
    assert done.returncode == 0, done.stderr
    return folder


def test_a_run_reaches_its_accuracy(room, result):
    done = geogs("eval", result, "--gt", room, "--no-plots")
    assert done.returncode == 0, done.stderr
    scores = json.loads((result / "eval.json").read_text())
    assert scores["trajectory"]["ate_rmse_cm"] < 0.5
    assert scores["trajectory"]["pairs"] == FRAMES
    surface = scores["reconstruction"]
    assert surface["accuracy_cm"] < 4.0
    assert surface["completeness_ratio"] > 70.0


def test_a_run_leaves_every_file(result):
    names = [
        "trajectory.tum", "keyframes.tum", "intrinsics.json", "mesh.ply", "splats.ply",
        "map.safetensors", "config.yaml", "summary.json", "report/trajectory.png",
        "report/keyframes.png", "report/mesh.png",
    ]  # fmt: skip
    assert [n for n in names if not (result / n).is_file()] == []
    trajectory = read_tum_trajectory(result / "trajectory.tum")
    assert np.allclose(np.diff(trajectory.timestamps), 1 / 30, atol=1e-6)
    disks = load_map(result / "map.safetensors")
    summary = json.loads((result / "summary.json").read_text())
    assert disks.is_finite()
    assert 1000 < len(disks) < 30_000
    assert summary["disks"] == len(disks)
    assert summary["frames"] == FRAMES
    assert summary["lost_spans"] == []
    assert summary["peak_memory_bytes"] < 2e9


def test_the_online_result_and_the_depths_alone_are_written_too(room, result):
    online = read_tum_trajectory(result / "online" / "trajectory.tum")
    final = read_tum_trajectory(result / "trajectory.tum")
    assert len(online.timestamps) == len(final.timestamps) == FRAMES
    assert 0 < np.abs(online.T_wc - final.T_wc).max() < 0.1
    seconds = json.loads((result / "summary.json").read_text())["seconds"]
    assert seconds["online results"] > 0
    assert seconds["depth fusion"] > 0
    assert seconds["total"] == pytest.approx(sum(seconds.values()) - seconds["total"], abs=0.1)
    keyframes = read_tum_trajectory(result / "online" / "keyframes.tum")
    assert 4 < len(keyframes.timestamps) < FRAMES
    meshes = [read_surface(result / n / "mesh.ply") for n in ("online", "depth_fusion", ".")]
    assert all(len(mesh.faces) > 1000 for mesh in meshes)
    assert len({len(mesh.faces) for mesh in meshes}) == 3


def test_ground_truth_is_never_read(room, result, tmp_path):
    """Without the truth beside the images the poses come out the same, bit for bit.

    Nor do the results that were asked for besides change anything.
    """
    bare = tmp_path / "bare"
    (bare / "results").mkdir(parents=True)
    (bare / "cam_params.json").write_bytes((room / "cam_params.json").read_bytes())
    for image in (room / "results").glob("frame*"):
        (bare / "results" / image.name).write_bytes(image.read_bytes())
    done = geogs("run", bare, "-o", tmp_path / "out", *QUICK)
    assert done.returncode == 0, done.stderr
    again = (tmp_path / "out" / "trajectory.tum").read_bytes()
    assert again == (result / "trajectory.tum").read_bytes()
    disks, twin = (
        load_map(tmp_path / "out" / "map.safetensors"),
        load_map(result / "map.safetensors"),
    )
    assert (disks.position == twin.position).all()


def test_interrupting_keeps_what_there_is(room, tmp_path):
    out, log = tmp_path / "out", tmp_path / "log"
    command = [*GEOGS, "run", str(room), "-o", str(out), *QUICK]
    with log.open("wb") as stream:
        process = subprocess.Popen(command, stdout=stream, stderr=stream)
        # The progress line counts keyframes once the map has been started.
        deadline = time.monotonic() + 240
        while time.monotonic() < deadline and process.poll() is None:
            if re.search(r"[1-9]\d* keyframes", log.read_text(errors="replace")):
                break
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=240) == 0, log.read_text(errors="replace")
    summary = json.loads((out / "summary.json").read_text())
    assert summary["interrupted"] is True
    assert 0 < summary["frames"] < FRAMES
    assert len(read_tum_trajectory(out / "trajectory.tum").timestamps) == summary["frames"]


FULL_AT_38 = """
import sys
import torch
from geogs.cli.main import main
from geogs.slam import Slam

process = Slam.process

def run_full(self, frame):
    if frame.index == 38:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
    return process(self, frame)

Slam.process = run_full
sys.exit(main(sys.argv[1:]))
"""


def test_a_full_gpu_memory_keeps_what_there_is(room, tmp_path):
    command = [sys.executable, "-c", FULL_AT_38, "run", str(room), "-o", str(tmp_path), *QUICK]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.returncode == 2
    assert "memory of the GPU was full after 38 frames" in done.stderr
    assert "Traceback" not in done.stderr
    assert len(read_tum_trajectory(tmp_path / "trajectory.tum").timestamps) == 38
    assert json.loads((tmp_path / "summary.json").read_text())["interrupted"] is True


FULL_AT_THE_END = """
import sys
import torch
import geogs.slam
from geogs.cli.main import main

def full(*arguments):
    raise torch.cuda.OutOfMemoryError("CUDA out of memory.")

geogs.slam.global_bundle = full
sys.exit(main(sys.argv[1:]))
"""


def test_a_gpu_that_is_full_in_the_final_stages_keeps_the_online_result(room, tmp_path):
    command = [sys.executable, "-c", FULL_AT_THE_END, "run", str(room), "-o", str(tmp_path), *QUICK]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr
    assert "no memory left for the final stages" in done.stderr
    assert len(read_tum_trajectory(tmp_path / "trajectory.tum").timestamps) == FRAMES
    assert json.loads((tmp_path / "summary.json").read_text())["interrupted"] is True


def images(folder: Path, frames: list[np.ndarray]) -> Path:
    folder.mkdir()
    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"{i:04d}.png"), frame)
    return folder


def noise(seed: int = 0) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    return cv2.resize(coarse, (256, 192), interpolation=cv2.INTER_CUBIC)


def turned(degrees: float) -> np.ndarray:
    """The picture of a camera turned about its vertical axis, seeing a far panorama."""
    coarse = np.random.default_rng(1).integers(0, 255, (60, 120, 3), dtype=np.uint8)
    panorama = cv2.resize(coarse, (960, 480), interpolation=cv2.INTER_CUBIC)
    K = np.array([[200.0, 0, 127.5], [0, 200, 95.5], [0, 0, 1]])
    wide = np.array([[200.0, 0, 479.5], [0, 200, 239.5], [0, 0, 1]])
    R = cv2.Rodrigues(np.array([0.0, np.radians(degrees), 0.0]))[0]
    return cv2.warpPerspective(panorama, K @ R @ np.linalg.inv(wide), (256, 192))


CASES = {
    "one frame": [noise()],
    "static video": [noise()] * 30,
    "black frames": [np.zeros((192, 256, 3), np.uint8)] * 20,
    "pure rotation": [turned(0.7 * i - 14) for i in range(40)],
}


@pytest.mark.parametrize("name", CASES)
def test_hopeless_input_gets_one_sentence(name, tmp_path):
    folder = images(tmp_path / "images", CASES[name])
    done = geogs(
        "run", folder, "-o", tmp_path / "out", "--intrinsics", "200,200,127.5,95.5", *QUICK
    )
    assert done.returncode == 2, done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert len(errors) == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert len(errors[0]) > 30


def test_a_result_of_little_worth_says_so(tmp_path):
    """Frames that have nothing to do with each other: an error, or a warning and lost spans."""
    folder = images(tmp_path / "images", [noise(i) for i in range(20)])
    done = geogs(
        "run", folder, "-o", tmp_path / "out", "--intrinsics", "200,200,127.5,95.5", *QUICK
    )
    assert "Traceback" not in done.stderr
    if done.returncode == 0:
        assert "not tracked" in done.stderr
        assert json.loads((tmp_path / "out" / "summary.json").read_text())["lost_spans"]
    else:
        assert done.returncode == 2


def test_a_gap_of_black_frames_is_survived_and_reported(room, tmp_path):
    """Frames that show nothing are marked as lost; the camera is found again after them."""
    files = sorted((room / "results").glob("frame*"))
    frames = [cv2.imread(str(f)) for f in files]
    for i in range(26, 30):
        frames[i] = np.zeros_like(frames[i])
    folder = images(tmp_path / "images", frames)
    camera = json.loads((room / "cam_params.json").read_text())["camera"]
    intrinsics = ",".join(str(camera[k]) for k in ("fx", "fy", "cx", "cy"))
    done = geogs("run", folder, "-o", tmp_path / "out", "--intrinsics", intrinsics, *QUICK)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [[round(30 * t) for t in span] for span in summary["lost_spans"]] == [[26, 29]]
    done = geogs("eval", tmp_path / "out", "--gt", room, "--no-plots")
    scores = json.loads((tmp_path / "out" / "eval.json").read_text())
    assert scores["keyframes"]["ate_rmse_cm"] < 0.6
