"""Files here and elsewhere; elsewhere is fsspec's file system in memory, and a server that speaks
S3 where moto and s3fs are installed."""

import os
import uuid

import pytest

from geogs.errors import InputError
from geogs_fleet.storage import StoragePath

pytest.importorskip("fsspec", reason="fsspec is not installed: pip install 'geogs[fleet]'")


@pytest.fixture(scope="module")
def bucket():
    """A bucket of a server in this process."""
    server_of = pytest.importorskip("moto.server", reason="pip install 'moto[server]' s3fs")
    s3fs = pytest.importorskip("s3fs", reason="pip install 'moto[server]' s3fs")
    server = server_of.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    host, port = server.get_host_and_port()
    said = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ACCESS_KEY_ID": "any", "AWS_SECRET_ACCESS_KEY": "any",
    }  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        for name, value in said.items():
            patch.setenv(name, value)
        s3fs.S3FileSystem().mkdir("geogs")
        yield f"s3://geogs/{uuid.uuid4().hex}"
    server.stop()


@pytest.fixture(params=["path", "file", "memory", "s3"])
def place(request, tmp_path) -> StoragePath:
    if request.param == "s3":
        return StoragePath(request.getfixturevalue("bucket"))
    kinds = {"path": str(tmp_path), "file": f"file://{tmp_path}"}
    return StoragePath(kinds.get(request.param, f"memory://{uuid.uuid4().hex}"))


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
    assert (StoragePath(str(tmp_path)) / "source.json").read() is None


def test_a_folder_comes_back_as_it_went(tmp_path):
    place = StoragePath(f"memory://{uuid.uuid4().hex}")
    (tmp_path / "one").write_bytes(b"\0\1")
    (place / "x/one").upload(tmp_path / "one")
    (place / "x/y/two").upload(tmp_path / "one")
    place.download(tmp_path / "back")
    assert (tmp_path / "back/x/y/two").read_bytes() == b"\0\1"
    assert (tmp_path / "back/x/one").read_bytes() == b"\0\1"


def test_patterns_elsewhere_give_whole_addresses():
    place = StoragePath(f"memory://{uuid.uuid4().hex}")
    for name in ("b.mp4", "a.mp4", "c.txt"):
        (place / name).write("x")
    assert [StoragePath(a).name for a in (place / "*.mp4").matching()] == ["a.mp4", "b.mp4"]
    assert all(StoragePath(a).read() == "x" for a in (place / "*.mp4").matching())


def test_what_is_not_there_and_what_nobody_can_reach(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        StoragePath(f"memory://{uuid.uuid4().hex}").download(tmp_path / "x")
    with pytest.raises(InputError, match="cannot be reached"):
        StoragePath("nonsense://host/file").read()
