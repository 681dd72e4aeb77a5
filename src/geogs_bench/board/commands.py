"""A command as a user types it, in its own process, with its time and memory.

Run as a script this file is the process between: the reported memory of a child counts that of the
process that made it, so that has to be small.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # as a script it knows no packages
    from geogs_bench.board.with_constant import Constant


@dataclass(frozen=True)
class Spent:
    """Time and memory of a process, and its exit code."""

    code: int
    seconds: float
    """Wall-clock time from its start to its end."""
    processor_seconds: float
    """Processor time of all its threads, and of the processes that it started and waited for."""
    memory_bytes: int
    """Peak memory of it, or of one of these processes."""


def run_geogs(
    arguments: Sequence[str],
    log: Path,
    caches: Path | None = None,
    changed: "tuple[Constant, float] | None" = None,
) -> tuple[Spent, str]:
    """Run ``geogs`` to its end; return its time and memory, and the last line of its output.

    Args:
        arguments: of the command.
        log: file for its output.
        caches: folder for new, empty caches of compiled code; the usual ones if none is given.
        changed: a constant with another value.
    """
    program = ["geogs.cli.main"]
    if changed is not None:
        program = ["geogs_bench.board.with_constant", str(changed[0]), repr(changed[1])]
    command = [sys.executable, "-m", *program, *arguments]
    found = dict(os.environ)
    for name in () if caches is None else ("NUMBA_CACHE_DIR", "GEOGS_CACHE"):
        found[name] = tempfile.mkdtemp(prefix=f"{name.lower()}-", dir=caches)
    with log.open("w") as said:
        said.write(f"$ geogs {' '.join(arguments)}\n")
        said.flush()
        done = subprocess.run(
            [sys.executable, "-I", __file__, *command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=said,
            env=found,
            check=True,
        )
    lines = log.read_text(errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return Spent(**json.loads(done.stdout)), last[:300]


def measured(command: Sequence[str]) -> Spent:
    """Run a command to its end; its output goes to the standard error."""
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=sys.stderr)
    # Popen.wait would reap the process without its resource usage.
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    unit = 1 if sys.platform == "darwin" else 1024
    spent = usage.ru_utime + usage.ru_stime
    return Spent(process.returncode, seconds, spent, usage.ru_maxrss * unit)


if __name__ == "__main__":
    print(json.dumps(asdict(measured(sys.argv[1:]))))
