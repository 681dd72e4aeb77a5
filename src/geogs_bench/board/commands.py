"""A command as a user types it, in a process of its own, and what it took."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Spent:
    """What a process took, and how it ended."""

    code: int
    seconds: float
    """By the clock on the wall, from its start to its end."""
    processor_seconds: float
    """Of all its threads, and of the processes that it started and waited for."""
    memory_bytes: int
    """The most that it, or one of these, had in memory."""
    last_line: str
    """Of what it said."""


def run_geogs(arguments: Sequence[str], log: Path, environment: Mapping[str, str]) -> Spent:
    """Run ``geogs`` with some arguments to its end; ``log`` gets what it says."""
    command = [sys.executable, "-m", "geogs.cli.main", *arguments]
    start = time.perf_counter()
    with log.open("w") as said:
        said.write(f"$ geogs {' '.join(arguments)}\n")
        said.flush()
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=said, stderr=said, env=environment
        )
        # Popen.wait would take the process away without saying what it used.
        _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    lines = log.read_text(errors="replace").split("\n")
    said_last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    unit = 1 if sys.platform == "darwin" else 1024
    return Spent(
        process.returncode,
        seconds,
        usage.ru_utime + usage.ru_stime,
        usage.ru_maxrss * unit,
        said_last[:300],
    )


def environment(caches: Path | None = None) -> dict[str, str]:
    """The environment of a command; with new folders below ``caches`` for what it compiles, if
    that is given."""
    found = dict(os.environ)
    for name in () if caches is None else ("NUMBA_CACHE_DIR", "GEOGS_CACHE"):
        found[name] = tempfile.mkdtemp(prefix=f"{name.lower()}-", dir=caches)
    return found
