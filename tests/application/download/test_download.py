"""Sequences from a server on this machine: fetched in parts, compared, unpacked safely."""

import hashlib
import io
import tarfile
import threading
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from geogs.application.download.download import download, unpack
from geogs.application.download.sequences import (
    SEQUENCES,
    PublicFile,
    PublicSequence,
    find_sequence,
)
from geogs.cli.main import main
from geogs.errors import InputError
from geogs.io.sources.sniff import open_source
from io_samples import write_images


@dataclass
class Server:
    """What it holds, how much of it it gives at once, and what it was asked."""

    address: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    most: int = 1 << 30
    """Bytes after which it hangs up."""
    ranges: list[str | None] = field(default_factory=list)
    redirects: dict[str, str] = field(default_factory=dict)


@pytest.fixture
def server() -> Iterator[Server]:
    said = Server()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path in said.redirects:
                self.send_response(302)
                self.send_header("Location", said.redirects[self.path])
                self.end_headers()
                return
            whole, wanted = said.files.get(self.path), self.headers["Range"]
            said.ranges.append(wanted)
            if whole is None:
                self.send_error(404)
                return
            start = int(wanted.removeprefix("bytes=")[:-1]) if wanted else 0
            if start >= len(whole):
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{len(whole)}")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            self.send_response(206 if wanted else 200)
            self.send_header("Content-Length", str(len(whole) - start))
            self.end_headers()
            self.wfile.write(whole[start : start + said.most])
            self.close_connection = True

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as listening:
        threading.Thread(target=listening.serve_forever, daemon=True).start()
        said.address = f"http://127.0.0.1:{listening.server_port}"
        yield said
        listening.shutdown()


@pytest.fixture
def sequence(server, tmp_path) -> PublicSequence:
    """Three images of TUM in an archive, with noise that nothing can shrink."""
    folder = write_images(tmp_path / "made" / "fr1_some", [f"rgb/{k}.png" for k in range(3)])
    (folder / "rgb.txt").write_text("".join(f"{k}.5 rgb/{k}.png\n" for k in range(3)))
    (folder / "noise.bin").write_bytes(np.random.default_rng(0).bytes(100_000))
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as tar:
        tar.add(folder, "fr1_some")
    server.files = {"/a.tgz": packed.getvalue(), "/x.gt.freiburg": b"0 0 0 0 0 0 0 1\n"}
    return PublicSequence(
        "some/fr1_some", "fr1_some", PublicFile(f"{server.address}/a.tgz"), "CC0", "",
        (PublicFile(f"{server.address}/x.gt.freiburg"),),
    )  # fmt: skip


def test_a_sequence_is_fetched_unpacked_and_read(sequence, tmp_path):
    place = download(sequence, tmp_path / "data")
    assert place == tmp_path / "data" / "fr1_some"
    assert [f.timestamp for f in open_source(place)] == [0.5, 1.5, 2.5]
    assert (place / "x.gt.freiburg").read_bytes() == b"0 0 0 0 0 0 0 1\n"
    assert [p.name for p in (tmp_path / "data").iterdir()] == ["fr1_some"]
    assert download(sequence, tmp_path / "data") == place  # nothing is left to do


def test_it_goes_on_where_it_was_cut_off(sequence, server, tmp_path):
    server.most = 60_000
    with pytest.raises(InputError, match=r"the same command goes on\.$"):
        download(sequence, tmp_path)
    part = tmp_path / "a.tgz.part"
    assert part.stat().st_size == 60_000
    server.most = 1 << 30
    assert (download(sequence, tmp_path) / "rgb.txt").is_file()
    assert server.ranges == [None, "bytes=60000-", None]
    assert not part.exists()


def test_a_part_that_is_whole_is_not_fetched_again(sequence, server, tmp_path):
    (tmp_path / "a.tgz.part").write_bytes(server.files["/a.tgz"])
    assert (download(sequence, tmp_path) / "rgb.txt").is_file()
    (tmp_path / "again").mkdir()
    (tmp_path / "again" / "a.tgz.part").write_bytes(server.files["/a.tgz"] + b"more")
    with pytest.raises(InputError, match="cannot be fetched"):
        download(sequence, tmp_path / "again")
    assert (download(sequence, tmp_path / "again") / "rgb.txt").is_file()


def test_what_is_not_the_published_file_is_refused(sequence, server, tmp_path):
    data = server.files["/a.tgz"]
    for sha256, is_good in ((hashlib.sha256(data).hexdigest(), True), ("0" * 64, False)):
        known = replace(sequence, archive=replace(sequence.archive, sha256=sha256))
        if is_good:
            download(known, tmp_path / "good")
        else:
            with pytest.raises(InputError, match="is not the file that was published"):
                download(known, tmp_path / "bad")
            assert not (tmp_path / "bad").exists()
    server.files["/a.tgz"] = data[:-3000] + b"x" * 3000
    with pytest.raises(InputError, match="is damaged"):
        download(sequence, tmp_path / "damaged")
    assert [p.name for p in (tmp_path / "damaged").iterdir()] == ["a.tgz"]


def test_servers_that_cannot_be_used_are_told(sequence, server, tmp_path):
    missing = replace(sequence, archive=PublicFile(f"{server.address}/none.tgz"))
    with pytest.raises(InputError, match=r"none\.tgz cannot be fetched \(Not Found\)"):
        download(missing, tmp_path)
    server.redirects["/none.tgz"] = "file:///etc/passwd"
    with pytest.raises(InputError, match="cannot be fetched"):
        download(missing, tmp_path)
    nobody = replace(sequence, archive=PublicFile("http://127.0.0.1:9/a.tgz"))
    with pytest.raises(InputError, match="cannot be fetched"):
        download(nobody, tmp_path)


def tar_of(change: Callable[[tarfile.TarInfo], None]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        with tarfile.open(path, "w") as tar:
            member = tarfile.TarInfo("a/b.txt")
            change(member)
            tar.addfile(member, io.BytesIO(b"x" * member.size))

    return write


def zip_of(name: str, mode: int = 0o100644) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        entry = zipfile.ZipInfo(name)
        entry.external_attr = mode << 16
        with zipfile.ZipFile(path, "w") as packed:
            packed.writestr(entry, b"/etc/passwd")

    return write


def named(name: str) -> Callable[[tarfile.TarInfo], None]:
    return lambda member: setattr(member, "name", name)


def of_type(kind: bytes) -> Callable[[tarfile.TarInfo], None]:
    def change(member: tarfile.TarInfo) -> None:
        member.type, member.linkname = kind, "/etc/passwd"

    return change


@pytest.mark.parametrize(
    "write",
    [
        tar_of(named("../b.txt")), tar_of(named("/tmp/b.txt")), tar_of(named("a/../../b")),
        tar_of(named("a\\..\\b")), tar_of(of_type(tarfile.SYMTYPE)),
        tar_of(of_type(tarfile.LNKTYPE)), tar_of(of_type(tarfile.FIFOTYPE)),
        zip_of("../b.txt"), zip_of("/b.txt"), zip_of("C:b.txt"), zip_of("a/b", 0o120777),
    ],
)  # fmt: skip
def test_archives_cannot_reach_out_of_their_folder(tmp_path, write):
    write(tmp_path / "archive")
    with pytest.raises(InputError, match="it is not used"):
        unpack(tmp_path / "archive", tmp_path / "in" / "here")
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == [tmp_path / "archive"]
    assert not Path("/tmp/b.txt").exists()


def test_an_archive_of_next_to_nothing_does_not_fill_the_disk(tmp_path, monkeypatch):
    monkeypatch.setattr("geogs.application.download.download._MIN_LIMIT", 1 << 20)
    with zipfile.ZipFile(tmp_path / "archive", "w", zipfile.ZIP_DEFLATED) as packed:
        for k in range(3):
            packed.writestr(f"{k}.bin", bytes(400 << 10))
    with pytest.raises(InputError, match="far more than images"):
        unpack(tmp_path / "archive", tmp_path / "here")


def test_the_list_names_each_once_and_encrypted(capsys):
    assert main(["download"]) == 0
    said = capsys.readouterr().out
    for sequence in SEQUENCES:
        assert f"  {sequence.name} " in said
        assert sequence.licence in said
        files = [sequence.archive, *sequence.beside]
        assert all(file.url.startswith("https://") for file in files)
    assert len({s.name for s in SEQUENCES}) == len(SEQUENCES)
    assert find_sequence("tum/fr1_desk").folder == "rgbd_dataset_freiburg1_desk"
    assert main(["download", "tum/fr1_dsk", "x"]) == 2
    assert "did you mean tum/fr1_desk?" in capsys.readouterr().err


def zip_with(method: int, path: Path, content: bytes) -> None:
    with zipfile.ZipFile(path, "w", method) as packed:
        packed.writestr("a/b.bin", content)


def tar_with(form: str, path: Path, content: bytes) -> None:
    with tarfile.open(path, form) as tar:
        member = tarfile.TarInfo("a/b.bin")
        member.size = len(content)
        tar.addfile(member, io.BytesIO(content))


PACKED: dict[str, Callable[[Path, bytes], None]] = {
    **{
        f"zip-{method}": partial(zip_with, method)
        for method in (
            zipfile.ZIP_STORED,
            zipfile.ZIP_DEFLATED,
            zipfile.ZIP_BZIP2,
            zipfile.ZIP_LZMA,
        )
    },
    **{f"tar-{form}": partial(tar_with, form) for form in ("w:", "w:gz", "w:bz2", "w:xz")},
}


@pytest.mark.parametrize("kind", PACKED)
def test_an_archive_damaged_anywhere_is_unpacked_or_refused_in_a_sentence(kind, tmp_path):
    """The decompressors raise errors of their own, each another one."""
    archive = tmp_path / "archive"
    PACKED[kind](archive, np.random.default_rng(0).bytes(3000))
    good = archive.read_bytes()
    refused = []
    for place in np.linspace(0, len(good) - 4, 60).astype(int).tolist():
        for value in (b"\xff\xff\xff\xff", b"\0\0\0\0"):
            archive.write_bytes(good[:place] + value + good[place + 4 :])
            try:
                unpack(archive, tmp_path / f"{place}-{value[0]}")
            except InputError as error:
                refused.append(str(error))
    assert len(refused) >= 4
    assert {said.rpartition("; ")[2] for said in refused} <= {
        "delete it and fetch it again.",
        "it is not used.",
    }
