"""Checkpoints of strangers: what they name is opened only where the user names it, too."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from crafted_checkpoints import reseal
from geogs.application import run as runs
from geogs.application.checkpoints.checkpoint import checkpoint_folder, write_checkpoint
from geogs.application.checkpoints.folder import is_sealed, seal
from geogs.application.checkpoints.run_state import RunMetadata, RunState, SavedRun
from geogs.application.named_files import options_missing
from geogs.application.run_settings import RunSettings
from geogs.cli import main as cli
from geogs.config import Config
from geogs.config.leaves import leaves, with_values
from geogs.config.setting import NamesFile
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.slam import Slam
from geogs.types import Frame
from io_samples import gradient_image

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
NAMING = [
    leaf for leaf in leaves(RunSettings)
    if (leaf.kind.base is Path or leaf.mark(NamesFile)) and leaf.name not in ("source", "output")
]  # fmt: skip
PATH, TEXT = (next(x for x in NAMING if x.kind.base is base) for base in (Path, str))
OUTSIDE = [
    *((leaf, "/proc/self/mem") for leaf in NAMING),
    *((leaf, name) for leaf in (PATH, TEXT) for name in ("../secret", "http://host/file")),
]
"""Every setting that names a file, and for a path and a text every kind of name."""
ADDRESSES = [
    "http://host/v.mp4", "https:/host/v.mp4", "rtsp://host/1", "rtmp://host/1", "tcp://host:1",
    "udp://host:1", "camera:0", "-", "play:/dev/zero",
]  # fmt: skip


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    """A cache folder of the test's own."""
    monkeypatch.setenv("GEOGS_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def begun(output: Path, settings: RunSettings) -> None:
    """A run of a few frames with these settings."""
    slam = Slam(CAMERA, Config(), device="cpu")
    for k in range(3):
        slam.process(Frame(k, k / 30, np.roll(gradient_image(0), 2 * k, axis=1)))
    facts = RunMetadata(settings, "cpu", "0123456789abcdef", None)
    write_checkpoint(checkpoint_folder(output), RunState(facts, slam.settled()))


def becomes_foreign(monkeypatch: pytest.MonkeyPatch, elsewhere: Path) -> None:
    """What was written so far has been written by another user or on another machine."""
    monkeypatch.setenv("GEOGS_CACHE", str(elsewhere))


def refused(output: Path, monkeypatch, capsys, *more: str) -> str:
    """The sentence; nothing that would be read as a source may be opened before."""

    def opened(*_: object) -> None:
        raise AssertionError("a source was opened")

    monkeypatch.setattr(runs, "open_source", opened)
    code, said = cli.main(["run", *more, "--resume", str(output)]), capsys.readouterr().err
    assert code == 2
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    return said


def test_an_own_checkpoint_goes_on_with_all_that_it_names(tmp_path):
    settings = RunSettings((tmp_path / "v.mp4",)).absolute()
    begun(tmp_path / "out", settings)
    assert SavedRun(tmp_path / "out").settings == settings


def test_of_a_stranger_the_video_has_to_be_given(tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    begun(out, RunSettings((tmp_path / "v.mp4",)))
    becomes_foreign(monkeypatch, tmp_path / "another")
    assert SavedRun(out).settings.source == ()
    said = refused(out, monkeypatch, capsys)
    assert "was not made by you on this machine" in said
    assert f"give SOURCE beside --resume {out}" in said
    with pytest.raises(InputError, match="was not made by you"):
        runs.resume(out)
    given = replace(SavedRun(out).settings, source=(tmp_path / "v.mp4",))
    asked = runs.continued(SavedRun(out).metadata, given, out)
    assert asked.source == (tmp_path / "v.mp4",)


def test_what_lies_in_the_folder_that_the_user_named_may_be_opened(tmp_path, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    (out / "link").symlink_to(tmp_path)
    becomes_foreign(monkeypatch, tmp_path / "another")
    for name, is_inside in (("v.mp4", True), ("link/v.mp4", False), ("../v.mp4", False)):
        begun(out, RunSettings((out / name,)))
        monkeypatch.setenv("GEOGS_CACHE", str(tmp_path / name.replace("/", "-")))
        assert bool(SavedRun(out).settings.source) is is_inside


@pytest.mark.parametrize(("leaf", "name"), OUTSIDE, ids=lambda case: getattr(case, "name", case))
def test_no_other_file_is_opened_on_its_word(tmp_path, monkeypatch, capsys, leaf, name):
    """Masks, weights, priors, calibrations, poses, maps: every setting that names a file."""
    out, usual = tmp_path / "out", RunSettings((tmp_path / "out" / "v.mp4",))
    value = Path(name) if leaf.kind.base is Path else name
    begun(out, with_values(usual, {leaf.path: value}))
    becomes_foreign(monkeypatch, tmp_path / "another")
    assert SavedRun(out).settings == usual
    assert f"{leaf.options[-1]} {leaf.path[-1].upper()}" in refused(out, monkeypatch, capsys)


@pytest.mark.parametrize(
    ("address", "is_own"), [*((address, True) for address in ADDRESSES), (ADDRESSES[0], False)]
)
def test_no_address_is_opened(tmp_path, monkeypatch, capsys, address, is_own):
    """Not even where the checkpoint is one's own: a run of a live source makes none."""
    begun(tmp_path / "out", RunSettings((Path(address),)))
    if not is_own:
        becomes_foreign(monkeypatch, tmp_path / "another")
    assert "names a live source" in refused(tmp_path / "out", monkeypatch, capsys)


def test_every_setting_with_a_path_is_known():
    """All paths, and the texts whose help says that they may be files."""
    texts = [x for x in leaves(RunSettings) if x.kind.base is str and "file" in x.help]
    others = {"mapping.when"}
    assert {leaf.name for leaf in texts} - {leaf.name for leaf in NAMING} <= others
    assert len(NAMING) == 10
    assert options_missing(RunSettings(), RunSettings((Path("a"),), map=Path("b"))) == [
        "SOURCE", "--map MAP"
    ]  # fmt: skip


def test_a_changed_checkpoint_is_no_longer_ones_own(tmp_path):
    """Its checksums can be made by anybody, its seal cannot."""
    out = tmp_path / "out"
    begun(out, RunSettings((tmp_path / "v.mp4",)))
    path = out / "checkpoint" / "state-1.json"
    assert SavedRun(out).settings.source
    manifest = json.loads((out / "checkpoint" / "manifest.json").read_text())
    assert len(manifest["seal"]) == 64
    path.write_text(path.read_text().replace("/v.mp4", "/w.mp4"))
    reseal(out)
    assert SavedRun(out).settings.source == ()


def test_the_key_is_for_its_user_alone(cache):
    assert not is_sealed(b"a", "")
    assert not (cache / "checkpoint.key").exists()  # nothing is made by looking
    first = seal(b"a")
    key = cache / "checkpoint.key"
    assert key.stat().st_mode & 0o777 == 0o600
    assert [path.name for path in cache.iterdir()] == [key.name]
    assert seal(b"a") == first
    assert is_sealed(b"a", first)
    assert not is_sealed(b"b", first)
    assert not is_sealed(b"a", "ü\ud800")
    key.chmod(0o644)
    assert not is_sealed(b"a", first)  # others could have read it
    assert seal(b"a") == ""
    key.unlink()
    os.mkfifo(key, 0o600)
    assert seal(b"a") == ""
    key.unlink()
    assert seal(b"a") not in ("", first)


def test_without_a_place_for_the_key_there_is_no_seal(cache):
    cache.write_text("no folder")
    assert seal(b"a") == ""
    assert not is_sealed(b"a", "")
