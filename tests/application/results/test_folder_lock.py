"""One run at a time in a folder, and a lock that dies with its owner."""

import subprocess
import sys

import pytest

from geogs.application.results.output_folder import LOCK, only_writer
from geogs.errors import OutputError

OWNER = """
import fcntl, sys
file = open(sys.argv[1], "w")
fcntl.flock(file, fcntl.LOCK_EX)
print("locked", flush=True)
input()
"""


def test_the_second_writer_is_refused_until_the_first_has_ended(tmp_path):
    with (
        only_writer(tmp_path),
        pytest.raises(OutputError, match=r"Another run is writing into .*\(-o\)\.$"),
        only_writer(tmp_path),
    ):
        pass
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(KeyboardInterrupt), only_writer(tmp_path):
        raise KeyboardInterrupt
    with only_writer(tmp_path):
        assert [path.name for path in tmp_path.iterdir()] == [LOCK]


def test_a_lock_dies_with_its_owner(tmp_path):
    owner = subprocess.Popen(
        [sys.executable, "-c", OWNER, str(tmp_path / LOCK)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    with owner:
        assert owner.stdout.readline() == b"locked\n"
        with pytest.raises(OutputError), only_writer(tmp_path):
            pass
        owner.kill()
        owner.wait()
    with only_writer(tmp_path):
        pass


def test_where_no_lock_can_be_made_nobody_is_refused(tmp_path):
    (tmp_path / LOCK).symlink_to(tmp_path / "elsewhere")
    with only_writer(tmp_path):
        pass
    assert not (tmp_path / "elsewhere").exists()
