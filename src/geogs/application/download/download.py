"""A public sequence, fetched and unpacked into a folder of its name."""

import hashlib
import http.client
import os
import shutil
import tarfile
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, TypeVar

from geogs.application.download.sequences import PublicSequence
from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.output_folder import claimed
from geogs.errors import GeogsError, InputError, OutputError
from geogs.guard.documents import in_short


def download(sequence: PublicSequence, into: Path, progress: RunProgress | None = None) -> Path:
    """Fetch a sequence into ``into``, or resume an earlier attempt. Returns its folder.

    The archive is deleted once its files are there.

    Raises:
        InputError: it cannot be fetched, or is damaged.
        OutputError: a file cannot be written.
    """
    progress = progress or RunProgress()
    with claimed(into) as folder:
        place = folder / sequence.folder
        if not place.exists():
            archive = folder / sequence.archive.name
            if not archive.is_file():
                said = sequence.archive
                fetch(said.url, archive, said.sha256, lambda part: progress.stage("download", part))
            progress.stage("unpacking", 0.0)
            new = folder / f".{sequence.folder}.new"
            try:
                shutil.rmtree(new, ignore_errors=True)
                unpack(archive, new)
                new.rename(place)
            finally:
                shutil.rmtree(new, ignore_errors=True)
            archive.unlink()
        for file in sequence.beside:
            if not (place / file.name).exists():
                progress.stage("download: truth", 0.0)
                fetch(file.url, place / file.name, file.sha256, lambda _: None)
    return place


_MIN_LIMIT = 1 << 30
"""Unpacked size in bytes that is always allowed."""

T = TypeVar("T")
Member = tuple[str, int, Callable[[], IO[bytes] | None]]
"""Name, size in bytes, and opener of a plain file in an archive."""


def unpack(archive: Path, folder: Path) -> None:
    """Unpack a ``.zip`` or a tar file into a new folder, without a common top folder.

    Raises:
        InputError: it is damaged, or holds links, devices, or names that lead out of the folder.
        OutputError: a file cannot be written.
    """
    # Images hardly shrink in an archive.
    most = max(50 * archive.stat().st_size, _MIN_LIMIT)
    try:
        folder.mkdir(parents=True)
        for name, size, opened in _guarded(_members(archive), archive):
            most -= size
            if most < 0:
                raise InputError(f"{archive} would unpack to far more than images; it is not used.")
            path = folder / _inside(name, archive)
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("xb") as file:
                file.writelines(_guarded(_chunks(opened), archive))
    except OSError as error:
        raise OutputError(f"{folder} cannot be written ({error.strerror}).") from None
    _lift(folder)


def _guarded(read: Iterator[T], archive: Path) -> Iterator[T]:
    """Read an archive. Raises InputError for any error in reading it."""
    try:
        yield from read
    except (GeogsError, MemoryError):
        raise
    except Exception as error:  # of tarfile, of zipfile, and of all that decompress for them
        raise InputError(
            f"{archive} is damaged ({in_short(error)}); delete it and fetch it again."
        ) from None


def _members(archive: Path) -> Iterator[Member]:
    """The plain files. Raises InputError for anything but files and folders."""
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as packed:
            for entry in packed.infolist():
                kind = entry.external_attr >> 28
                if kind not in (0, 0o4, 0o10):
                    raise InputError(f"{archive} holds what is no plain file; it is not used.")
                if not entry.is_dir():
                    yield entry.filename, entry.file_size, partial(packed.open, entry)
        return
    with tarfile.open(archive, "r:*") as tar:
        for member in tar:
            if not (member.isreg() or member.isdir()):
                raise InputError(f"{archive} holds what is no plain file; it is not used.")
            if member.isreg():
                yield member.name, member.size, partial(tar.extractfile, member)


def _inside(name: str, archive: Path) -> PurePosixPath:
    """The name below the folder. Raises InputError for one that leads elsewhere."""
    path = PurePosixPath(name)
    leads_out = path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name
    if leads_out or ":" in name or not path.parts:
        raise InputError(f"{archive} holds a name that leads out of its folder; it is not used.")
    return path


def _chunks(opened: Callable[[], IO[bytes] | None]) -> Iterator[bytes]:
    stream = opened()
    assert stream is not None, "of a plain file"
    with closing(stream):
        yield from iter(partial(stream.read, 1 << 20), b"")


def _lift(folder: Path) -> None:
    """Replace the folder by its only sub-folder, if all lies in that."""
    inside = list(folder.iterdir())
    if len(inside) == 1 and inside[0].is_dir():
        own = inside[0].rename(folder.with_name(f"{folder.name}.inner"))
        folder.rmdir()
        own.rename(folder)


Report = Callable[[float], None]


class _OnlyHttp(urllib.request.HTTPRedirectHandler):
    """Refuses redirections away from HTTP, and from HTTPS to an unencrypted address."""

    def redirect_request(self, req, fp, code, msg, headers, newurl):  # type: ignore[no-untyped-def]
        allowed = ("https://",) if req.full_url.startswith("https://") else ("https://", "http://")
        if not newurl.startswith(allowed):
            raise urllib.error.URLError("it leads to an address that is not encrypted")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def fetch(url: str, path: Path, sha256: str, report: Report) -> None:
    """Download a file to ``path``; ``path.part`` is the incomplete file.

    Args:
        url: address of the file.
        path: where to put it.
        sha256: expected checksum; empty where it is not known.
        report: called with the received fraction, in [0, 1].

    Raises:
        InputError: the server cannot be reached, has no such file, or the file is damaged.
        OutputError: it cannot be written.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        expected = _received(url, part, report)
        size = part.stat().st_size
        if expected is not None and size != expected:
            raise InputError(
                f"{url} ended after {size} of {expected} bytes; the same command goes on."
            )
        _check(part, url, sha256)
        part.replace(path)
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError) as error:
        why = error.reason if isinstance(error, urllib.error.URLError) else error
        raise InputError(
            f"{url} cannot be fetched ({why or type(error).__name__}); the same command goes on."
        ) from None
    except ConnectionError as error:
        raise InputError(f"{url} was cut off ({error}); the same command goes on.") from None
    except OSError as error:
        raise OutputError(f"{path} cannot be written ({error.strerror}).") from None


def _received(url: str, part: Path, report: Report) -> int | None:
    """Append the missing bytes. Returns the file size given by the server."""
    there = part.stat().st_size if part.is_file() else 0
    request = urllib.request.Request(url, headers={"User-Agent": "geogs"})
    if there:
        request.add_header("Range", f"bytes={there}-")
    opener = urllib.request.build_opener(_OnlyHttp)
    try:
        answer = opener.open(request, timeout=30.0)  # seconds without a byte
    except urllib.error.HTTPError as error:
        if error.code == http.client.REQUESTED_RANGE_NOT_SATISFIABLE and there:
            whole = error.headers.get("Content-Range", "").rpartition("/")[2]
            if whole == str(there):
                return there
            part.unlink()  # of another file
        raise
    with answer:
        goes_on = answer.status == http.client.PARTIAL_CONTENT
        length = answer.headers.get("Content-Length", "")
        there = there if goes_on else 0
        total = there + int(length) if length.isdecimal() else None
        with open(part, "ab" if goes_on else "wb", opener=_no_link) as file:
            while chunk := answer.read(1 << 20):
                file.write(chunk)
                there += len(chunk)
                report(there / total if total else 0.0)
    return total


def _no_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


def _check(part: Path, url: str, sha256: str) -> None:
    if not sha256:
        return
    with part.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != sha256:
        part.unlink()
        raise InputError(f"{url} is not the file that was published: its SHA-256 is {found}.")
