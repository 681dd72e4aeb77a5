"""Checkpoints of a small state: complete or not there, checked, and nothing foreign is touched."""

import errno
import json
import os
import pickle
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from crafted_checkpoints import reseal
from geogs.application.checkpoints.checkpoint import (
    Checkpoint,
    SavedState,
    checkpoint_folder,
    has_checkpoint,
    write_checkpoint,
)
from geogs.application.progress.run_progress import RunProgress
from geogs.errors import InputError, OutputError
from geogs.stopwatch import Stopwatch
from geogs.version import __version__
from geogs.world.archive import Archive, Archived


@dataclass
class Work:
    """Some work."""

    steps: int
    position: Float32[Tensor, "n 3"]
    weight: Float64[np.ndarray, "n"]
    archive: Archive
    pictures: list[Archived]


@dataclass
class State:
    """What is stored of it."""

    name: str
    work: Work


def state(steps: int, archive: Archive | None = None, pictures: int = 3) -> State:
    """One whose content follows from a number."""
    archive = archive or Archive()
    stored = [archive.put(np.full((20, 30), steps + k, np.uint8)) for k in range(pictures)]
    position = torch.arange(30.0).reshape(10, 3) + steps
    return State("it", Work(steps, position, np.arange(10.0) * steps, archive, stored))


def read(output: Path) -> State:
    saved = SavedState(output, State)
    return State(saved.plain("name"), saved.work("work"))


def assert_is(made: State, steps: int) -> None:
    wanted = state(steps)
    assert made.name == "it"
    assert made.work.steps == steps
    assert torch.equal(made.work.position, wanted.work.position)
    np.testing.assert_array_equal(made.work.weight, wanted.work.weight)
    for k, picture in enumerate(made.work.pictures):
        assert (picture.load() == steps + k).all()
        assert picture.load().shape == (20, 30)


@pytest.fixture
def output(tmp_path) -> Path:
    """A folder of results with a complete checkpoint of number 5."""
    out = tmp_path / "out"
    write_checkpoint(checkpoint_folder(out), state(5))
    return out


def files(output: Path) -> dict[str, Path]:
    """The files of a checkpoint by their kinds: manifest, json, safetensors, archive."""
    folder = output / "checkpoint"
    found = {p.suffix[1:] or "archive": p for p in folder.iterdir() if p.name != "manifest.json"}
    return {"manifest": folder / "manifest.json", **found}


def changed_values(output: Path, change: Callable[[dict], object]) -> None:
    """A checkpoint whose JSON a stranger has made up, all checksums right."""
    path = files(output)["json"]
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))
    reseal(output)


def refused(output: Path, wanted: str) -> None:
    with pytest.raises(InputError, match=wanted) as caught:
        read(output)
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith("start anew without --resume.")


# --- what is written ----------------------------------------------------------------------------


def test_a_state_comes_back_and_the_next_replaces_it(output):
    made = read(output)
    assert_is(made, 5)
    assert has_checkpoint(output)
    archive = made.work.archive
    later = state(6, archive)
    later.work.pictures[0] = made.work.pictures[1]  # some from before
    write_checkpoint(checkpoint_folder(output), later)
    again = read(output)
    assert again.work.steps == 6
    assert (again.work.pictures[0].load() == 6).all()
    assert again.work.archive.name == archive.name
    names = sorted(p.name for p in (output / "checkpoint").iterdir())
    assert names == [archive.name, "manifest.json", "state-2.json", "state-2.safetensors"]
    checkpoint_folder(output).remove()
    assert list(output.iterdir()) == []
    assert not has_checkpoint(output)


def test_another_run_begins_with_archives_of_its_own(output):
    write_checkpoint(checkpoint_folder(output), state(9))
    assert_is(read(output), 9)
    assert len(list((output / "checkpoint").iterdir())) == 4


def test_what_was_archived_after_the_state_is_cut_off(output):
    made = read(output)
    end = files(output)["archive"].stat().st_size
    made.work.archive.put(np.ones(1000))
    assert files(output)["archive"].stat().st_size > end
    again = read(output)
    assert files(output)["archive"].stat().st_size == end
    assert_is(again, 5)


def test_a_checkpoint_reads_no_old_arrays(output, monkeypatch):
    made = read(output)

    def unread(*_: object) -> None:
        raise AssertionError("an archive was read")

    monkeypatch.setattr(os, "preadv", unread)
    monkeypatch.setattr(os, "pread", unread)
    write_checkpoint(checkpoint_folder(output), made)


@pytest.mark.parametrize(("call", "uses"), [("replace", 2), ("fsync", 5), ("pwrite", 1)])
def test_a_full_disk_leaves_the_last_state(output, monkeypatch, call, uses):
    """Whatever fails, the last complete state is there, and nothing half written."""
    for nth in range(uses):
        with monkeypatch.context() as patch:
            _fail_at(patch, call, nth)
            with pytest.raises(OutputError, match="No space left"):
                write_checkpoint(checkpoint_folder(output), state(6))
        assert_is(read(output), 5)
    write_checkpoint(checkpoint_folder(output), state(7))
    assert_is(read(output), 7)
    assert len(list((output / "checkpoint").iterdir())) == 4


def _fail_at(patch: pytest.MonkeyPatch, call: str, nth: int) -> None:
    """Let the n-th use of a function of the system find a full disk."""
    real, count = getattr(os, call), [0]

    def failing(*arguments: object, **named: object) -> object:
        count[0] += 1
        if count[0] == nth + 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(*arguments, **named)

    patch.setattr(os, call, failing)


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_full_disk_at_the_first_state_leaves_nothing(tmp_path, monkeypatch, call):
    _fail_at(monkeypatch, call, 0)
    with pytest.raises(OutputError, match="No space left"):
        write_checkpoint(checkpoint_folder(tmp_path), state(1))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("writes", [False, True])
def test_what_a_kill_at_the_first_state_leaves_goes_with_the_next_result(tmp_path, writes):
    (tmp_path / "checkpoint").mkdir()
    (tmp_path / "checkpoint" / ".manifest.json.part").write_text("{")
    if writes:
        write_checkpoint(checkpoint_folder(tmp_path), state(1))
    checkpoint_folder(tmp_path).remove()
    assert list(tmp_path.iterdir()) == []


def manifest_number(path: Path) -> int:
    return json.loads(path.read_text())["number"] if path.exists() else 0


def test_a_kill_at_any_time_leaves_a_complete_state(tmp_path):
    """SIGKILL at ten times of a process that does nothing but write states."""
    out, last = tmp_path / "out", 0
    manifest = out / "checkpoint" / "manifest.json"
    for n in range(10):
        before = manifest_number(manifest)
        child = os.fork()
        if child == 0:
            steps, archive = last, Archive()
            while True:
                steps += 1
                write_checkpoint(checkpoint_folder(out), state(steps, archive))
        while manifest_number(manifest) < before + 3:
            time.sleep(0.005)
        time.sleep(0.003 * n)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        made = read(out)
        assert made.work.steps > last
        last = made.work.steps
        assert_is(made, last)
    checkpoint_folder(out).remove()
    assert list(out.iterdir()) == []


def test_where_nothing_can_be_written_that_is_said_once(tmp_path, monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(RunProgress, "write", lambda _, text: said.append(text))
    (tmp_path / "checkpoint").touch()
    checkpoint = Checkpoint(tmp_path, 0.001, lambda: state(1), RunProgress(), Stopwatch())
    assert not checkpoint.write()
    assert not checkpoint.write()
    assert len(said) == 1
    assert said[0].startswith("No more checkpoints: ")
    assert "it is no folder" in said[0]


@pytest.mark.parametrize("is_there", [True, False], ids=["a link", "nothing"])
def test_in_a_folder_that_was_swapped_no_checkpoint_is_begun(tmp_path, monkeypatch, is_there):
    said: list[str] = []
    monkeypatch.setattr(RunProgress, "write", lambda _, text: said.append(text))
    out = tmp_path / "out"
    elsewhere = tmp_path / "elsewhere"
    out.mkdir()
    elsewhere.mkdir()
    checkpoint = Checkpoint(out, 0.001, lambda: state(1), RunProgress(), Stopwatch())
    assert checkpoint.write()
    out.rename(tmp_path / "moved")
    if is_there:
        out.symlink_to(elsewhere)
    assert not checkpoint.write()
    assert not checkpoint.write()
    assert said == [f"No more checkpoints: {out} is another folder than at the beginning."]
    assert not list(elsewhere.iterdir())
    assert out.is_symlink() == is_there
    assert (tmp_path / "moved" / "checkpoint" / "manifest.json").is_file()


# --- what others put there ------------------------------------------------------------------------


def test_a_foreign_file_stays_and_so_does_the_folder(output):
    own = output / "checkpoint" / "notes.txt"
    own.write_text("mine")
    write_checkpoint(checkpoint_folder(output), state(6))
    checkpoint_folder(output).remove()
    assert [p.name for p in (output / "checkpoint").iterdir()] == ["notes.txt"]
    assert own.read_text() == "mine"


def test_a_folder_of_the_user_stays(tmp_path):
    folder = tmp_path / "checkpoint"
    folder.mkdir()
    (folder / "archive-of-mine").write_text("mine")
    write_checkpoint(checkpoint_folder(tmp_path), state(1))
    (folder / "archive-of-mine").unlink()
    checkpoint_folder(tmp_path).remove()
    assert list(folder.iterdir()) == []


def test_a_manifest_of_others_is_left_alone(tmp_path):
    folder = tmp_path / "checkpoint"
    folder.mkdir()
    (folder / "manifest.json").write_text('{"files": ["a"]}')
    with pytest.raises(OutputError, match="left alone"):
        write_checkpoint(checkpoint_folder(tmp_path), state(1))
    checkpoint_folder(tmp_path).remove()
    assert (folder / "manifest.json").read_text() == '{"files": ["a"]}'
    refused(tmp_path, "damaged, or none of geogs")


def test_a_link_in_place_of_the_folder_is_not_followed(output, tmp_path):
    real = tmp_path / "real"
    (output / "checkpoint").rename(real)
    (output / "checkpoint").symlink_to(real)
    before = {p.name: p.read_bytes() for p in real.iterdir()}
    refused(output, "it is a link")
    assert not has_checkpoint(output)
    with pytest.raises(OutputError, match="it is a link"):
        write_checkpoint(checkpoint_folder(output), state(6))
    checkpoint_folder(output).remove()
    assert (output / "checkpoint").is_symlink()
    assert {p.name: p.read_bytes() for p in real.iterdir()} == before


@pytest.mark.parametrize("kind", ["manifest", "json", "safetensors", "archive"])
def test_a_link_in_place_of_a_file_is_not_followed(output, tmp_path, kind):
    path, victim = files(output)[kind], tmp_path / "victim"
    path.rename(victim)
    path.symlink_to(victim)
    with victim.open("ab") as stream:
        stream.write(b"more")  # would be cut off
    before = victim.read_bytes()
    refused(output, "is a link, and none is followed")
    checkpoint_folder(output).remove()
    assert victim.read_bytes() == before
    assert path.is_symlink()


def test_a_file_with_another_name_and_a_pipe_are_refused(output, tmp_path):
    path, victim = files(output)["archive"], tmp_path / "victim"
    os.link(path, victim)
    refused(output, "has other names")
    path.unlink()
    os.mkfifo(path)
    refused(output, "no plain file|cannot be opened")


# --- made up by a stranger ------------------------------------------------------------------------


class _Harm:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.path),)


def test_a_pickle_is_not_executed(output, tmp_path):
    harm = pickle.dumps(_Harm(tmp_path / "harm"))
    (output / "checkpoint" / "state").write_bytes(harm)  # as it once was
    assert_is(read(output), 5)
    for kind in ("json", "safetensors", "manifest"):
        copy = tmp_path / kind
        shutil.copytree(output, copy)
        files(copy)[kind].write_bytes(harm)
        if kind != "manifest":
            reseal(copy)
        refused(copy, "cannot be used")
    old = tmp_path / "old" / "checkpoint"
    old.mkdir(parents=True)
    title = f"geogs run checkpoint 1, geogs {__version__}\n".encode()
    (old / "state").write_bytes(title + harm + b"0000")
    with pytest.raises(InputError, match="nothing to resume"):
        read(old.parent)
    assert not (tmp_path / "harm").exists()


@pytest.mark.parametrize("kind", ["archive", "state", "deleted"])
@pytest.mark.parametrize(
    "name", ["precious.txt", "archive-of-mine", "state-1.txt", "notes", ".manifest.json.part.txt"]
)
def test_names_that_geogs_does_not_give_are_refused(output, kind, name):
    """Files of others in the folder itself are neither cut off, nor read, nor deleted."""
    precious, paths = output / "checkpoint" / name, files(output)
    precious.write_text("precious " * 1000)
    if kind == "archive":
        text = paths["json"].read_text().replace(paths["archive"].name, name)
        paths["json"].write_text(text)
    manifest = json.loads(paths["manifest"].read_text())
    manifest["files"].append(name)
    if kind == "state":
        manifest["state"][0][0] = name
    paths["manifest"].write_text(json.dumps(manifest))
    reseal(output)
    refused(output, "is no name of a file of a checkpoint")
    with pytest.raises(OutputError, match="is left alone"):
        write_checkpoint(checkpoint_folder(output), state(6))
    checkpoint_folder(output).remove()
    assert precious.read_text() == "precious " * 1000


def test_an_archive_that_the_manifest_does_not_name_is_refused(output):
    """What looks like one of ours, but is not said to be, is not cut off either."""
    own, other = files(output)["archive"], output / "checkpoint" / f"archive-{'0' * 16}"
    other.write_text("precious " * 1000)
    text = files(output)["json"].read_text().replace(own.name, other.name)
    files(output)["json"].write_text(text)
    reseal(output)
    refused(output, "is none of its files")
    assert other.read_text() == "precious " * 1000


@pytest.mark.parametrize("where", ["up", "absolute", "folder", "manifest", "deleted"])
def test_names_of_other_places_are_refused(output, tmp_path, where):
    """An archive is cut to its length, a state's old files are deleted: of no other folder."""
    victim = tmp_path / "victim"
    victim.write_text("precious " * 1000)
    archive = files(output)["archive"].name
    name = {"up": "../../victim", "absolute": str(victim), "folder": "a/b"}.get(
        where, "../../victim"
    )
    if where in ("manifest", "deleted"):
        path = files(output)["manifest"]
        manifest = json.loads(path.read_text())
        if where == "deleted":
            manifest["files"].append(name)
        else:
            manifest["state"][0][0] = name
        path.write_text(json.dumps(manifest))
        reseal(output)
    else:
        text = files(output)["json"].read_text().replace(archive, name)
        files(output)["json"].write_text(text)
        reseal(output)
    if where == "deleted":
        with pytest.raises(OutputError, match="is left alone"):
            write_checkpoint(checkpoint_folder(output), state(6))
        checkpoint_folder(output).remove()
    refused(output, "is no name of a file of a checkpoint|is none of its files")
    assert victim.read_text() == "precious " * 1000


@pytest.mark.parametrize(
    "change",
    [
        lambda v: v["archives"][0][1].update(end=1 << 40),
        lambda v: v["archives"][0][1].update(end=-1),
        lambda v: v["archives"][0][1].update(free=[[-8, 16]]),
        lambda v: v["archives"][0][1].update(resident=-1),
        lambda v: v["archives"].clear(),
        lambda v: v["state"]["work"]["pictures"][0].update(offset=-600),
        lambda v: v["state"]["work"]["pictures"][0].update(offset=1 << 70),
        lambda v: v["state"]["work"]["pictures"][0].update(shape=[1 << 40, 1 << 40]),
        lambda v: v["state"]["work"]["pictures"][0].update(shape=[-20, -30]),
        lambda v: v["state"]["work"]["pictures"][0].update(shape=[0, 1 << 80]),
        lambda v: v["state"]["work"]["pictures"][0].update(dtype="object"),
        lambda v: v["state"]["work"]["pictures"][0].update(dtype="O8"),
        lambda v: v["state"]["work"]["pictures"][0].update(checksum=7),
        lambda v: v["state"]["work"]["pictures"][0].update(archive="manifest.json"),
        lambda v: v["state"]["work"].update(steps=[[[]]]),
        lambda v: v["state"].pop("work"),
        lambda v: v.pop("archives"),
    ],
)
def test_a_state_that_cannot_be_is_one_sentence(output, change):
    changed_values(output, change)
    refused(output, "cannot be used")


# --- damage ---------------------------------------------------------------------------------------


def test_mutated_bytes_are_told_or_do_not_matter(output):
    """Fifty of each file, some with right checksums again: a sentence, or the right state."""
    rng, told = np.random.default_rng(0), 0
    for path in files(output).values():
        good = path.read_bytes()
        for _ in range(50):
            data = bytearray(good)
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
            path.write_bytes(data)
            try:
                assert_is(read(output), 5)
            except InputError:
                told += 1
        path.write_bytes(good)
    assert told > 190


def test_mutated_bytes_with_right_checksums_never_crash(output):
    rng, manifest = np.random.default_rng(1), files(output)["manifest"].read_bytes()
    for kind in ("json", "safetensors"):
        path = files(output)[kind]
        good = path.read_bytes()
        for _ in range(60):
            data = bytearray(good)
            for _ in range(rng.integers(1, 4)):
                data[rng.integers(len(data))] = rng.integers(256)
            path.write_bytes(data)
            reseal(output)
            try:
                made = read(output)
            except InputError:
                continue
            assert made.work.position.shape == (10, 3)
        path.write_bytes(good)
        files(output)["manifest"].write_bytes(manifest)
    assert_is(read(output), 5)


@pytest.mark.parametrize("kind", ["manifest", "json", "safetensors", "archive"])
def test_a_file_that_is_cut_off_longer_or_gone_is_one_sentence(output, kind):
    path = files(output)[kind]
    good = path.read_bytes()
    path.write_bytes(good[: len(good) // 2])
    refused(output, "is cut off|is damaged")
    path.write_bytes(b"")
    refused(output, "is cut off|is damaged")
    if kind != "archive":  # what was written to that later is cut off
        path.write_bytes(good + b"0")
        refused(output, "has changed|is damaged")
    path.unlink()
    with pytest.raises(InputError, match=r"cannot be opened|nothing to resume"):
        read(output)


def test_another_version_or_kind_of_state_is_one_sentence(output, monkeypatch):
    @dataclass
    class Other:
        name: str
        work: int

    with pytest.raises(InputError, match="another command, or another version"):
        SavedState(output, Other)
    monkeypatch.setattr("geogs.application.checkpoints.checkpoint.__version__", "99.0")
    refused(output, "another version than this")
