"""Closed, full and broken standard streams end no command, and no file gets their numbers."""

import os
import subprocess
import sys

import pytest

GEOGS = f"{sys.executable} -m geogs.cli.main"
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
NUMBERS = """
import os, sys
from geogs.cli.terminal.process import make_unbreakable
make_unbreakable()
file = open(sys.argv[1], "w")
print("lost")
print("lost", file=sys.stderr)
sys.exit(0 if file.fileno() > 2 and os.stat(sys.argv[1]).st_size == 0 else 1)
"""


def shell(command: str, **more: object) -> subprocess.CompletedProcess:
    return subprocess.run(
        ["bash", "-c", f"set -o pipefail; {command}"], env=ENVIRONMENT, timeout=1800,
        capture_output=True, **more,
    )  # fmt: skip


@pytest.mark.parametrize("to", [">&-", "2>&-", ">&- 2>&-", "<&- >&- 2>&-", ">/dev/full", "| true"])
def test_help_ends_well_wherever_it_goes(to):
    assert shell(f"{GEOGS} --help {to}").returncode == 0


@pytest.mark.parametrize("to", ["2>&-", "2>/dev/full", "2>&1 | true"])
def test_an_error_keeps_its_code_wherever_its_sentence_goes(to):
    assert shell(f"{GEOGS} nonsense {to}").returncode == 2


def test_no_file_gets_the_number_of_a_closed_stream(tmp_path):
    code = f"{sys.executable} -c '{NUMBERS}' {tmp_path / 'file'} >&- 2>&- <&-"
    assert shell(code).returncode == 0


def test_names_that_are_no_utf8_and_control_characters_are_escaped(tmp_path):
    name = os.fsencode(tmp_path) + b"/r\xf6om\x1b[31m"
    done = subprocess.run(
        [*GEOGS.split(), "weights", "verify", name], env=ENVIRONMENT, capture_output=True
    )
    assert done.returncode == 2
    assert b"\\udcf6om\\x1b[31m" in done.stderr
    assert b"\x1b" not in done.stderr
