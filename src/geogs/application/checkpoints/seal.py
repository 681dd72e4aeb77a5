"""Seals of checkpoints: proof that this user made them with this cache folder.

A seal is an HMAC-SHA256 by a key of 32 random bytes that is in the user's cache folder alone. No
seal can be made without the key; a checkpoint without a valid seal is used like any untrusted
file.
"""

import hmac
import os
import secrets
import stat
from contextlib import suppress
from pathlib import Path

from geogs.gpu.cache import cache_folder

_BYTES = 32


def seal(data: bytes) -> str:
    """The seal of some bytes; empty where no key can be kept."""
    key = _key() or _new_key()
    return "" if key is None else hmac.digest(key, data, "sha256").hex()


def is_sealed(data: bytes, by: str) -> bool:
    """Whether this user made that seal of some bytes."""
    key = _key()
    if key is None:
        return False
    own = hmac.digest(key, data, "sha256").hex()
    return hmac.compare_digest(own.encode(), by.encode("utf-8", "replace"))


def _path() -> Path:
    return cache_folder() / "checkpoint.key"


def _key() -> bytes | None:
    """The key; none where there is none, or another user could have read or written it."""
    try:
        file = os.open(_path(), os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    with os.fdopen(file, "rb") as stream:
        status = os.fstat(stream.fileno())
        is_plain = stat.S_ISREG(status.st_mode) and status.st_nlink == 1
        if not is_plain or status.st_uid != os.geteuid() or status.st_mode & 0o077:
            return None
        key = stream.read(_BYTES + 1)
    return key if len(key) == _BYTES else None


def _new_key() -> bytes | None:
    """Make and store a key, or take that of a faster process; none if it cannot be stored."""
    path = _path()
    unfinished = path.with_name(f"{path.name}.{secrets.token_hex(8)}")
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        with os.fdopen(os.open(unfinished, flags, 0o600), "wb") as stream:
            stream.write(secrets.token_bytes(_BYTES))
        with suppress(FileExistsError):
            os.link(unfinished, path)  # atomic, and never over another key
    with suppress(OSError):
        unfinished.unlink()
    return _key()
