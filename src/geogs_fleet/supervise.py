"""A supervised process: killed when it exceeds its time or memory."""

import os
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Literal

_LOOK = 0.5
"""Seconds between two checks of the process."""


@dataclass(frozen=True)
class Limits:
    """Limits of a process; none for no limit."""

    seconds: float | None = None
    memory: int | None = None
    """Bytes of resident memory."""


@dataclass(frozen=True)
class ProcessEnd:
    """Outcome of a process."""

    code: int
    """Exit code; negative for the signal that killed it."""
    said: str
    """Text on its standard output."""
    exceeded: Literal["", "time", "memory"] = ""


def supervise(
    command: Sequence[str],
    message: bytes,
    log: Path,
    limits: Limits,
    environment: Mapping[str, str],
    meanwhile: Callable[[], None],
) -> ProcessEnd:
    """Run a command until it ends or exceeds a limit.

    Args:
        command: program and arguments.
        message: content of its standard input, which stays open as long as this process lives.
        log: file to which its standard error is appended.
        limits: it is killed when it exceeds them.
        environment: its environment variables.
        meanwhile: called about twice a second.
    """
    begin = time.monotonic()
    exceeded: Literal["", "time", "memory"] = ""
    with TemporaryFile() as said, open(log, "ab", opener=_not_through_links) as errors:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=said, stderr=errors, env=dict(environment)
        )
        assert process.stdin is not None
        try:
            with suppress(BrokenPipeError):  # it has ended already; its exit code is read later
                process.stdin.write(message)
                process.stdin.flush()
            while process.poll() is None:
                if limits.seconds is not None and time.monotonic() - begin > limits.seconds:
                    exceeded = "time"
                    break
                if limits.memory is not None and resident(process.pid) > limits.memory:
                    exceeded = "memory"
                    break
                meanwhile()
                with suppress(subprocess.TimeoutExpired):
                    process.wait(_LOOK)
        finally:
            process.kill()
            process.wait()
            process.stdin.close()
        said.seek(0)
        return ProcessEnd(process.returncode, said.read().decode("utf-8", "replace"), exceeded)


def resident(process: int) -> int:
    """Bytes of memory that a process uses now; 0 if the system does not report it."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def _not_through_links(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)
