"""Download over HTTP, resumed where an earlier attempt ended."""

import hashlib
import http.client
import os
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

from geogs.errors import InputError, OutputError

_CHUNK = 1 << 20
_TIMEOUT = 30.0
"""Timeout in seconds without a byte."""

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
        answer = opener.open(request, timeout=_TIMEOUT)
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
            while chunk := answer.read(_CHUNK):
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
