"""A process under watch: ended when it takes too long or too much."""

import os
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Literal

_SHORTEST, _LONGEST = 0.02, 0.5
"""Seconds between two looks, which become rarer."""


@dataclass(frozen=True)
class Limits:
    """What a process may take; none lets it take what it needs."""

    seconds: float | None = None
    memory: int | None = None
    """Bytes of resident memory."""


@dataclass(frozen=True)
class Ending:
    """How a process ended."""

    code: int
    """Negative for the signal that killed it."""
    said: str
    """On its standard output."""
    exceeded: Literal["", "time", "memory"] = ""


def supervise(
    command: Sequence[str],
    message: bytes,
    log: Path,
    limits: Limits,
    environment: Mapping[str, str],
    meanwhile: Callable[[], None] = lambda: None,
) -> Ending:
    """Run a command until it ends, or has to.

    Args:
        command: program and arguments.
        message: what its standard input holds, which stays open for as long as we live.
        log: file to which its standard error is added.
        limits: it is killed when it exceeds them.
        environment: its environment variables.
        meanwhile: called about twice a second.
    """
    begin, pause = time.monotonic(), _SHORTEST
    exceeded: Literal["", "time", "memory"] = ""
    with TemporaryFile() as said, log.open("ab") as errors:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=said, stderr=errors, env=dict(environment)
        )
        try:
            _tell(process, message)
            while process.poll() is None:
                exceeded = _exceeded(process.pid, time.monotonic() - begin, limits)
                if exceeded:
                    break
                meanwhile()
                pause = min(1.2 * pause, _LONGEST)
                _wait(process, pause)
        finally:
            process.kill()
            process.wait()
            if process.stdin is not None:
                process.stdin.close()
        said.seek(0)
        return Ending(process.returncode, said.read().decode("utf-8", "replace"), exceeded)


def _tell(process: "subprocess.Popen[bytes]", message: bytes) -> None:
    assert process.stdin is not None
    try:
        process.stdin.write(message)
        process.stdin.flush()
    except BrokenPipeError:  # it has ended already, and how is asked later
        pass


def _wait(process: "subprocess.Popen[bytes]", seconds: float) -> None:
    with suppress(subprocess.TimeoutExpired):
        process.wait(seconds)


def _exceeded(process: int, seconds: float, limits: Limits) -> Literal["", "time", "memory"]:
    if limits.seconds is not None and seconds > limits.seconds:
        return "time"
    if limits.memory is not None and resident(process) > limits.memory:
        return "memory"
    return ""


def resident(process: int) -> int:
    """Bytes of memory that a process uses now; 0 where the system does not tell."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")
