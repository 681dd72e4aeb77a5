"""Files here and elsewhere; elsewhere is fsspec's file system in memory."""

import os
import uuid

import pytest

from geogs.errors import InputError
from geogs.fleet.places import Place

pytest.importorskip("fsspec", reason="fsspec is not installed: pip install 'geogs[fleet]'")


@pytest.fixture(params=["path", "file", "memory"])
def place(request, tmp_path) -> Place:
    kinds = {"path": str(tmp_path), "file": f"file://{tmp_path}"}
    return Place(kinds.get(request.param, f"memory://{uuid.uuid4().hex}"))


def test_text_is_read_as_written_until_it_is_deleted(place):
    file = place / "a/b.txt"
    assert file.read() is None
    file.write("grüße")
    assert file.read() == "grüße"
    assert place.listed() == {"a": True}
    assert (place / "a").listed() == {"b.txt": False}
    file.delete()
    file.delete()
    assert file.read() is None


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_is_no_plain_file_holds_no_text_and_is_not_waited_for(tmp_path, make):
    make(tmp_path / "source.json")
    assert (Place(str(tmp_path)) / "source.json").read() is None


def test_a_folder_comes_back_as_it_went(tmp_path):
    place = Place(f"memory://{uuid.uuid4().hex}")
    (tmp_path / "one").write_bytes(b"\0\1")
    (place / "x/one").upload(tmp_path / "one")
    (place / "x/y/two").upload(tmp_path / "one")
    place.download(tmp_path / "back")
    assert (tmp_path / "back/x/y/two").read_bytes() == b"\0\1"
    assert (tmp_path / "back/x/one").read_bytes() == b"\0\1"


def test_patterns_elsewhere_give_whole_addresses():
    place = Place(f"memory://{uuid.uuid4().hex}")
    for name in ("b.mp4", "a.mp4", "c.txt"):
        (place / name).write("x")
    assert [Place(a).name for a in (place / "*.mp4").matching()] == ["a.mp4", "b.mp4"]
    assert all(Place(a).read() == "x" for a in (place / "*.mp4").matching())


def test_what_is_not_there_and_what_nobody_can_reach(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        Place(f"memory://{uuid.uuid4().hex}").download(tmp_path / "x")
    with pytest.raises(InputError, match="cannot be reached"):
        Place("nonsense://host/file").read()
