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

from geogs.application.progress import RunProgress
from geogs.application.run_checkpoint import RunCheckpoint, RunFacts, frames_after
from geogs.application.settings import RunSettings
from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.sniff import open_sources
from geogs.io.writers.native import load_map
from geogs.slam import Slam
from geogs.synth.export import write_sequence
from geogs.tracking.segments import Segments

GEOGS = [sys.executable, "-m", "geogs.cli.main"]
FRAMES = 40
QUICK = [
    "--mapping.render-long-edge", "128", "--mapping.iterations", "4",
    "--mapping.pose-iterations", "1", "--mapping.final-iterations", "20",
    "--mapping.no-final-depth",
    "--tracking.resident-keyframes", "4", "--mapping.resident-views", "4",
]  # fmt: skip
OFTEN = ["--checkpoint-every", "0.05"]


def geogs(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [*GEOGS, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=400)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """The start of a synthetic room sequence, 256 x 192."""
    folder = tmp_path_factory.mktemp("room") / "room"
    write_sequence(folder, FRAMES, 256, 192)
    return folder


@pytest.fixture(scope="module")
def whole(room, tmp_path_factory) -> Path:
    """The result of a run that nothing disturbed, without a checkpoint."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    done = geogs("run", room, "-o", folder, *QUICK, "--checkpoint-every", 0)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def killed(room, tmp_path_factory) -> Path:
    """A run that was killed a while after its first checkpoint."""
    out = tmp_path_factory.mktemp("killed") / "out"
    call = ["run", room.name, "-o", str(out), *QUICK, *OFTEN, "--intrinsics", "camera.txt"]
    camera = json.loads((room / "cam_params.json").read_text())["camera"]
    text = ",".join(str(camera[k]) for k in ("fx", "fy", "cx", "cy"))
    (room.parent / "camera.txt").write_text(text)
    stop(call, signal.SIGKILL, out, 3, cwd=room.parent)  # resumed from elsewhere
    assert not (out / "summary.json").exists()
    return out


def stop(
    arguments: list[str], number: int, out: Path, checkpoints: int, cwd: Path | None = None
) -> str:
    """Start the command, signal it after some checkpoints; what it said."""
    state, seen = out / "checkpoint" / "state", set()
    log = out.parent / f"log{number}"
    with log.open("wb") as stream:
        command = [*GEOGS, *arguments]
        process = subprocess.Popen(command, stdout=stream, stderr=stream, cwd=cwd)
        before = state.stat().st_mtime_ns if state.exists() else 0
        deadline = time.monotonic() + 200
        while time.monotonic() < deadline and process.poll() is None and len(seen) < checkpoints:
            if state.exists() and state.stat().st_mtime_ns != before:
                seen.add(state.stat().st_mtime_ns)
            time.sleep(0.02)
        process.send_signal(number)
        code = process.wait(timeout=200)
    said = log.read_text(errors="replace")
    assert len(seen) == checkpoints, said
    assert code == (0 if number == signal.SIGINT else -number), said
    return " ".join(said.split())


def test_a_killed_run_goes_on_even_after_another_interruption(room, whole, killed, tmp_path):
    """SIGKILL, resume, Ctrl-C, resume: in the end all is as if nothing had happened."""
    out = tmp_path / "out"
    shutil.copytree(killed, out)
    said = stop(["run", "--resume", str(out), *OFTEN], signal.SIGINT, out, 2)
    assert "Going on after" in said
    assert f"geogs run --resume {out} goes on from here." in said
    summary = json.loads((out / "summary.json").read_text())
    assert summary["interrupted"] is True
    assert summary["frames"] < FRAMES
    done = geogs("run", "--resume", out)
    assert done.returncode == 0, done.stderr
    assert f"Going on after {summary['frames']} frames." in done.stderr
    assert not (out / "checkpoint").exists()
    for name in ("trajectory.tum", "keyframes.tum", "mesh.ply"):
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    disks, twin = load_map(out / "map.safetensors"), load_map(whole / "map.safetensors")
    assert (disks.position == twin.position).all()
    summary = json.loads((out / "summary.json").read_text())
    assert summary["interrupted"] is False
    assert 0 < summary["seconds"]["checkpoints"] < 0.1 * summary["seconds"]["total"]
    done = geogs("eval", out, "--gt", room, "--no-plots")
    assert json.loads((out / "eval.json").read_text())["trajectory"]["ate_rmse_cm"] < 0.5
    again = geogs("run", "--resume", out)
    assert again.returncode == 2
    assert "nothing to resume" in again.stderr.splitlines()[-1]


def test_a_run_killed_in_its_final_stages_does_only_those_again(room, whole, tmp_path):
    out = tmp_path / "out"
    (out / "checkpoint").mkdir(parents=True)
    for name in ("state", "archive-of-another-run"):
        (out / "checkpoint" / name).touch()
    # Nothing is due before the end of the stream.
    said = stop(["run", str(room), "-o", str(out), *QUICK, "--checkpoint-every", "900"],
                signal.SIGKILL, out, 1)  # fmt: skip
    assert f"Starting anew; geogs run --resume {out} would go on" in said
    assert not (out / "checkpoint" / "archive-of-another-run").exists()
    done = geogs("run", "--resume", out)
    assert done.returncode == 0, done.stderr
    assert f"Going on after {FRAMES} frames." in done.stderr
    assert (out / "mesh.ply").read_bytes() == (whole / "mesh.ply").read_bytes()


SEVERAL = """
import contextlib, io, json, sys
from geogs.cli.main import main

said = []
for arguments in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as stream:
        code = main(arguments)
    said.append([code, stream.getvalue()])
print(json.dumps(said))
"""


def sentences(calls: list[list[object]]) -> list[str]:
    """What each of some commands says when it fails; one process for all."""
    argument = json.dumps([[str(a) for a in call] for call in calls])
    command = [sys.executable, "-c", SEVERAL, argument]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert [code for code, _ in said] == [2] * len(calls), said
    assert all(text.startswith("error: ") and text.count("\n") == 1 for _, text in said), said
    return [text for _, text in said]


def test_what_cannot_be_resumed_is_one_sentence(killed, tmp_path):
    good = (killed / "checkpoint" / "state").read_bytes()
    cases = {
        "nothing to resume": None,
        "is cut off": good[:-100],
        "has changed": good[:5000] + bytes([good[5000] ^ 1]) + good[5001:],
        "content has changed": good + b"more",
        "no checkpoint of geogs": b"rubbish" * 50,
        "another version": b"geogs run checkpoint 1, geogs 0.0.1\n" + good,
    }
    calls: list[list[object]] = []
    for n, content in enumerate(cases.values()):
        out = tmp_path / str(n)
        (out / "checkpoint").mkdir(parents=True)
        if content is not None:
            (out / "checkpoint" / "state").write_bytes(content)
        calls.append(["run", "--resume", out])
    for n, change in enumerate((lambda p: os.truncate(p, 1000), Path.unlink)):
        out = tmp_path / f"archive{n}"
        shutil.copytree(killed, out)
        change(max((out / "checkpoint").glob("archive-*"), key=lambda p: p.stat().st_size))
        calls.append(["run", "--resume", out])
    calls.append(["run", "--resume", killed, "--stride", 2])
    calls.append(["run", "--resume", killed, "--preset", "fast"])
    more = ["is cut off", "cannot be opened", *["leave out everything else"] * 2]
    for wanted, said in zip([*cases, *more], sentences(calls), strict=True):
        assert wanted in said


def test_a_source_that_is_gone_or_changed_is_one_sentence(room, killed):
    image, moved = room / "results" / "frame000020.jpg", room.with_name("elsewhere")
    good, call = image.read_bytes(), [["run", "--resume", killed]]
    image.write_bytes(good + b"\0")
    try:
        assert "is not what it was when the run began" in sentences(call)[0]
    finally:
        image.write_bytes(good)
    room.rename(moved)
    try:
        assert f"{room} does not exist" in sentences(call)[0]
    finally:
        moved.rename(room)


def test_where_no_checkpoint_can_be_written_that_is_said_once(room, tmp_path, monkeypatch):
    monkeypatch.setattr(Segments, "keyframe_ids", [0])
    said: list[str] = []
    monkeypatch.setattr(RunProgress, "write", lambda _, text: said.append(text))
    source = open_sources([room])
    slam = Slam(source.camera)
    facts = RunFacts(RunSettings(), "cpu", source.fingerprint(), None, source.place)
    (tmp_path / "checkpoint").touch()
    checkpoint = RunCheckpoint(tmp_path, facts, 0.001, RunProgress(None))
    for _ in range(3):
        time.sleep(0.002)
        checkpoint.after_frame(slam, source)
    assert len(said) == 1
    assert said[0].startswith("No more checkpoints: ")
    assert not checkpoint.write(slam, source)


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
        source = open_sources(paths, config)
        frames = []
        for frame in source:
            frames.append(frame)
            places.append(source.place)
        assert len(frames) == count
        for n, place in enumerate(places, 1):
            other = open_sources(paths, config)
            rest = list(frames_after(other, place))
            assert [f.index for f in rest] == list(range(n, count))
            for own, theirs in zip(rest, frames[n:], strict=True):
                assert own.timestamp == theirs.timestamp
                assert own.follows_cut == theirs.follows_cut
                assert np.array_equal(own.image, theirs.image)
            assert other.skipped == source.skipped
            assert other.fingerprint() == source.fingerprint()
            if len(paths) == 2:
                assert other.spans == source.spans
    with pytest.raises(InputError, match="not what it was"):
        frames_after(source, open_sources(folders[:1], config).place)
