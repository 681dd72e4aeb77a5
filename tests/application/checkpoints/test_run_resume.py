"""``geogs run --resume``: checkpoints of a run that was interrupted or killed, and wrong ones."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from called_commands import done
from geogs.application.checkpoints.checkpoint import Checkpoint
from geogs.application.checkpoints.run_state import RunMetadata, run_state
from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.saved_result import load_result
from geogs.application.run_settings import RunSettings
from geogs.cli import main as cli
from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.sniff import open_source
from geogs.pose_estimate import PoseEstimate
from geogs.slam import Slam
from geogs.tracking.segment_trackers import Segments
from geogs.types import Frame
from geogs.version import __version__
from stopped_commands import STOPPED, stop

# One process runs them all: a room that they share is changed for a moment, and a run of another
# process that reads it just then gets another result.
pytestmark = [pytest.mark.system, pytest.mark.xdist_group("resumed-room")]

FRAMES = 20
QUICK = [
    "--stop", str(FRAMES), "--tracking.init-keyframes", "6",
    "--mapping.render-long-edge", "64", "--mapping.iterations", "2",
    "--mapping.pose-iterations", "1", "--mapping.final-iterations", "10",
    "--mapping.depth.planes", "32", "--mapping.when", "online",
    "--mapping.no-final-depth", "--resident-keyframes", "4", "--device", "cpu",
    "--input.readout", "0.01",
]  # fmt: skip
OFTEN = ["--checkpoint-every", "0.001"]


@pytest.fixture(scope="session")
def own_room(small_room, once) -> Path:
    """A room that the tests here may change for a moment."""
    return once("resumed-room", lambda folder: shutil.copytree(small_room, folder))


@pytest.fixture(scope="session")
def whole(own_room, once) -> Path:
    """The result of a run that nothing disturbed, without a checkpoint."""

    def run(folder: Path) -> None:
        done("run", own_room, "-o", folder, *QUICK, "--checkpoint-every", 0, report=False)

    return once("resumed-whole", run)


@pytest.fixture(scope="session")
def killed(own_room, once) -> Path:
    """A run that was killed when its third checkpoint was about to be complete."""

    def run(out: Path) -> None:
        call = ["run", own_room.name, "-o", str(out), *QUICK, *OFTEN, "--intrinsics", "camera.txt"]
        camera = json.loads((own_room / "cam_params.json").read_text())["camera"]
        text = ",".join(str(camera[k]) for k in ("fx", "fy", "cx", "cy"))
        (own_room.parent / "camera.txt").write_text(text)
        stop(call, signal.SIGKILL, checkpoints=3, cwd=own_room.parent)  # resumed from elsewhere
        assert not (out / "summary.json").exists()

    return once("resumed-killed", run)


def assert_same_map(out: Path, other: Path) -> None:
    """Every tensor of two maps, bit for bit."""
    own, twin = (load_file(folder / "map.safetensors") for folder in (out, other))
    assert own.keys() == twin.keys()
    for name in own:
        assert torch.equal(own[name], twin[name]), name


def goes_on(out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What ``geogs run --resume`` says while it ends a run."""
    capsys.readouterr()
    code, said = cli.main(["run", "--resume", str(out)]), capsys.readouterr()
    assert code in (0, 3), said.err
    return said.err


@pytest.mark.skipif("PYTEST_XDIST_WORKER" not in os.environ, reason="one process in any case")
def test_one_process_runs_all_of_these(request):
    assert request.node.nodeid.endswith("@resumed-room"), "run with --dist loadgroup"


@pytest.mark.usefixtures("no_report")
def test_a_killed_run_goes_on_even_after_another_interruption(
    small_room, whole, killed, tmp_path, capsys
):
    """SIGKILL, resume, Ctrl-C, resume: in the end all is as if nothing had happened."""
    out = tmp_path / "out"
    shutil.copytree(killed, out)
    said = stop(["run", "--resume", str(out), *OFTEN], signal.SIGINT, checkpoints=2)
    assert "Continuing after" in said
    assert f"geogs run --resume {out} continues from here." in said
    summary = json.loads((out / "summary.json").read_text())
    assert summary["interrupted"] is True
    assert summary["frames"] < FRAMES
    assert f"Continuing after {summary['frames']} frames." in goes_on(out, capsys)
    assert not (out / "checkpoint").exists()
    for name in ("trajectory.tum", "keyframes.tum", "mesh.ply", "keyframes/rows.safetensors"):
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    assert_same_map(out, whole)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["interrupted"] is False
    rows, size = load_result(out).rows(), (96 // 8 + 2, 128 // 8 + 2)
    assert len(rows) == summary["keyframes"]
    assert {tuple(r.seconds.shape) for r in rows.values()} == {size}
    assert 0.004 < max(float(r.seconds.abs().max()) for r in rows.values()) < 0.0075
    assert 0 < summary["seconds"]["checkpoints"] < summary["seconds"]["total"]
    assert cli.main(["run", "--resume", str(out)]) == 2
    assert "nothing to resume" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.long
@pytest.mark.usefixtures("no_report")
def test_ten_kills_change_nothing(whole, killed, tmp_path, capsys):
    """SIGKILL at ten points, at each of the files of a checkpoint; in the end, bit for bit."""
    out = tmp_path / "out"
    shutil.copytree(killed, out)  # the first
    call = ["run", "--resume", str(out), *OFTEN]
    stop(call, signal.SIGKILL, files=range(1, 10))
    goes_on(out, capsys)
    for name in ("trajectory.tum", "keyframes.tum", "mesh.ply"):
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    assert_same_map(out, whole)


@pytest.mark.long
@pytest.mark.usefixtures("no_report")
def test_a_run_whose_gpu_fails_and_is_full_goes_on_each_time(
    own_room, whole, tmp_path, capsys, monkeypatch
):
    """A failure leaves the last checkpoint, a full memory the results so far, too."""
    out, process = tmp_path / "out", Slam.process
    fails = {
        15: torch.AcceleratorError("CUDA error: unspecified launch failure\nCUDA kernel errors"),
        18: torch.cuda.OutOfMemoryError("CUDA out of memory."),
    }

    def failing(slam: Slam, frame: Frame) -> PoseEstimate:
        if slam.frames in fails:
            raise fails.pop(slam.frames)
        return process(slam, frame)

    monkeypatch.setattr(Slam, "process", failing)
    assert cli.main(["run", str(own_room), "-o", str(out), *QUICK, *OFTEN]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    way = f"geogs run --resume {out} continues from the last checkpoint."
    assert said == f"error: The GPU failed (CUDA error: unspecified launch failure). {way}"
    assert not (out / "summary.json").exists()
    assert cli.main(["run", "--resume", str(out), *OFTEN, "--device", "cpu"]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("error: The memory of the GPU was full after 18 frames")
    assert said.endswith(way)
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["frames"], summary["interrupted"]) == (18, True)
    assert "Continuing after" in goes_on(out, capsys)
    assert not fails
    for name in ("trajectory.tum", "mesh.ply"):
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name


@pytest.mark.long
@pytest.mark.usefixtures("no_report")
def test_a_run_killed_in_its_final_stages_does_only_those_again(
    own_room, whole, killed, tmp_path, capsys
):
    out = tmp_path / "out"
    shutil.copytree(killed, out)
    foreign = out / "checkpoint" / "notes.txt"
    foreign.write_text("mine")
    # Nothing is due before the end of the stream; the next to be put into its place is a result.
    call = ["run", str(own_room), "-o", str(out), *QUICK, "--checkpoint-every", "900"]
    call.append("--overwrite")
    command = [sys.executable, "-c", STOPPED, str(int(signal.SIGKILL)), "trajectory.tum", "1"]
    done = subprocess.run([*command, *call], capture_output=True, text=True, timeout=1800)
    assert "exit code -9" in done.stdout, done.stderr
    assert f"Continuing after {FRAMES} frames." in goes_on(out, capsys)
    assert (out / "mesh.ply").read_bytes() == (whole / "mesh.ply").read_bytes()
    assert [path.name for path in (out / "checkpoint").iterdir()] == ["notes.txt"]
    assert foreign.read_text() == "mine"


def sentences(calls: list[list[object]], capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What each of some commands says when it fails."""
    said = []
    capsys.readouterr()
    for call in calls:
        assert cli.main([str(a) for a in call]) == 2
        said.append(capsys.readouterr().err)
    assert all(text.startswith("error: ") and text.count("\n") == 1 for text in said), said
    return said


def test_what_cannot_be_resumed_is_one_sentence(killed, tmp_path, capsys):
    """Checkpoints that were damaged, made up, moved or are of another version."""

    def flip(path: Path) -> None:
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)

    def link(path: Path) -> None:
        path.rename(tmp_path / "victim")
        path.symlink_to(tmp_path / "victim")

    def old(path: Path) -> None:
        shutil.rmtree(path.parent)
        path.parent.mkdir()
        harm = f"cos\nmkdir\n(V{tmp_path / 'harm'}\ntR."  # a pickle, as there once were
        title = f"geogs run checkpoint 1, geogs {__version__}\n"
        (path.parent / "state").write_text(title + harm)

    cases = [
        ("nothing to resume", "manifest.json", lambda p: shutil.rmtree(p.parent)),
        ("nothing to resume", "manifest.json", old),
        ("manifest.json", "manifest.json", flip),
        ("is a link", "manifest.json", lambda p: link(p.parent)),
        ("is cut off", "*.json", lambda p: os.truncate(p, 1000)),
        ("has changed", "*.safetensors", flip),
        ("is cut off", "archive-*", lambda p: os.truncate(p, 1000)),
        ("cannot be opened", "archive-*", Path.unlink),
    ]
    calls: list[list[object]] = []
    for n, (_, name, change) in enumerate(cases):
        out = tmp_path / str(n)
        shutil.copytree(killed, out)
        change(max((out / "checkpoint").glob(name), key=lambda p: p.stat().st_size))
        calls.append(["run", "--resume", out])
    calls.append(["run", "--resume", killed, "--stride", 2])
    calls.append(["run", "--resume", killed, "--preset", "fast"])
    wanted = [w for w, *_ in cases] + ["leave out everything else", "leave out --preset"]
    for text, said in zip(wanted, sentences(calls, capsys), strict=True):
        assert text in said
    assert not (tmp_path / "harm").exists()


def test_a_source_that_is_gone_or_changed_is_one_sentence(own_room, killed, capsys):
    image = own_room / "results" / "frame000020.jpg"
    moved = own_room.with_name("elsewhere")
    good, call = image.read_bytes(), [["run", "--resume", killed]]
    image.write_bytes(good + b"\0")
    try:
        assert "is not what it was when the run began" in sentences(call, capsys)[0]
    finally:
        image.write_bytes(good)
    own_room.rename(moved)
    try:
        assert f"{own_room} does not exist" in sentences(call, capsys)[0]
    finally:
        moved.rename(own_room)


def test_where_no_checkpoint_can_be_written_that_is_said_once(small_room, tmp_path, monkeypatch):
    monkeypatch.setattr(Segments, "keyframe_ids", [0])
    said: list[str] = []
    monkeypatch.setattr(RunProgress, "write", lambda _, text: said.append(text))
    source = open_source([small_room])
    slam = Slam(source.camera, device="cpu")
    metadata = RunMetadata(RunSettings(), "cpu", source.fingerprint(), None, source.place)
    (tmp_path / "checkpoint").touch()
    checkpoint = Checkpoint(
        tmp_path, 0.001, lambda: run_state(metadata, slam, source), RunProgress(), slam.stopwatch
    )
    for _ in range(3):
        time.sleep(0.002)
        checkpoint.write_if_due()
    assert len(said) == 1
    assert said[0].startswith("No more checkpoints: ")
    assert not checkpoint.write()


def test_reading_goes_on_where_it_was(tmp_path):
    """One source or several, with images that cannot be read."""
    folders = []
    for n, count in enumerate((5, 4)):
        folder = tmp_path / str(n)
        folder.mkdir()
        for k in range(count):
            picture = np.full((48, 64, 3), 40 * n + 10 * k, np.uint8)
            cv2.imwrite(str(folder / f"{k:03d}.png"), picture)
        (folder / "002.png").write_bytes(b"broken")
        folders.append(folder)
    config = InputConfig(intrinsics="60,60,31.5,23.5")
    for paths, count in ((folders[:1], 4), (folders, 7)):
        places = []
        source = open_source(paths, config)
        frames = []
        for frame in source:
            frames.append(frame)
            places.append(source.place)
        assert len(frames) == count
        for n, place in enumerate(places, 1):
            other = open_source(paths, config)
            rest = list(other.frames_after(place))
            assert [f.index for f in rest] == list(range(n, count))
            for own, theirs in zip(rest, frames[n:], strict=True):
                assert own.timestamp == theirs.timestamp
                assert own.follows_cut == theirs.follows_cut
                assert np.array_equal(own.image, theirs.image)
            assert other.place == source.place
            assert other.fingerprint() == source.fingerprint()
            assert other.spans == source.spans
            assert len(other.spans) == (len(paths) if len(paths) > 1 else 0)
    with pytest.raises(InputError, match="not what it was"):
        open_source(folders[:1], config).frames_after(source.place)
