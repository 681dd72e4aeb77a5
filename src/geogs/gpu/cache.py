"""Compiled kernels on disk, so that only the first start compiles."""

import hashlib
import logging
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CacheState:
    """Kernels in the cache, and whether more can be written."""

    kernels: int
    """Number of compiled source files."""
    bytes: int
    problem: str | None
    """Reason why nothing can be written; None if it can."""


def cache_folder() -> Path:
    """``$GEOGS_CACHE``, else geogs in the user's cache directory."""
    if chosen := os.environ.get("GEOGS_CACHE"):
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    home = os.path.expanduser("~")
    if not base and not os.path.isabs(home):  # a user without a home directory
        return Path(tempfile.gettempdir()) / f"geogs-{os.getuid()}"
    return (Path(base) if base else Path(home) / ".cache") / "geogs"


def cache_key(*parts: str) -> str:
    """Name of a cached file: a hash of everything that its content depends on."""
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


def read_cubin(key: str) -> bytes | None:
    """A cached cubin; None where there is none or its checksum is wrong."""
    try:
        content = _path(key).read_bytes()
    except OSError:
        return None
    checksum = content[:32]
    cubin = content[32:]
    return cubin if hashlib.sha256(cubin).digest() == checksum else None


def write_cubin(key: str, cubin: bytes) -> None:
    """Store a cubin atomically, even if others write it, too; warn if it cannot be written."""
    path = _path(key)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(cubin).digest() + cubin)
        os.replace(name, path)
    except OSError as error:
        _log.warning(
            "compiled kernels cannot be kept in %s (%s), so every start compiles them again; "
            "set GEOGS_CACHE to a folder that can be written",
            path.parent,
            error.strerror or error,
        )


def cache_state() -> CacheState:
    """Count the kernels in the cache, and try to write there."""
    folder = _kernel_folder()
    files = list(folder.glob("*.cubin"))
    problem = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        problem = error.strerror or str(error)
    return CacheState(len(files), sum(f.stat().st_size for f in files), problem)


def _kernel_folder() -> Path:
    return cache_folder() / "kernels"


def _path(key: str) -> Path:
    return _kernel_folder() / f"{key}.cubin"
