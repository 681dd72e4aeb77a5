"""Commands that stop themselves where a file is put into its place: no clock decides where."""

import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

STOPPED = """
import os, sys
from geogs.cli.main import main
import geogs.application.run

def stop_at(number, name, count):
    \"\"\"Get the signal when the process puts a file into its place for that many times.\"\"\"
    left = [count]

    def watch(event, arguments):
        if event == "os.rename" and str(arguments[1]).endswith(name):
            left[0] -= 1
            if not left[0]:
                os.kill(os.getpid(), number)

    sys.addaudithook(watch)

number, name, counts, *arguments = sys.argv[1:]
for count in map(int, counts.split(",")):
    child = os.fork()
    if not child:
        stop_at(int(number), name, count)
        code = main(arguments)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    print("exit code", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""Runs a command that stops itself, one time for each number in a list."""


def stop(
    arguments: list[str],
    number: int,
    *,
    checkpoints: int = 0,
    files: Sequence[int] = (),
    cwd: Path | None = None,
) -> str:
    """Start the command, signal it when it completes a checkpoint; what it said.

    Or start it again and again, each time signalled when it puts one of a checkpoint's files, of
    that number since the start, into its place. No clock decides where.
    """
    name, counts = ("", files) if files else ("manifest.json", [checkpoints])
    command = [sys.executable, "-c", STOPPED, str(int(number)), name]
    command += [",".join(map(str, counts)), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1800, cwd=cwd)
    said = done.stdout + done.stderr
    code = -number if number == signal.SIGKILL else 128 + number
    assert re.findall(r"exit code (\S+)", done.stdout) == [str(int(code))] * len(counts), said
    return " ".join(said.split())
