"""Kernels are kept where they can be, and never where others can write."""

import os
import stat
import tempfile
from pathlib import Path

import pytest

from geogs.guard.kernel_folder import VARIABLE, can_be_written, find_kernel_folder, temporary_folder


@pytest.fixture
def temporary(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    return tmp_path


def test_where_numba_finds_a_folder_nothing_is_said(temporary):
    find_kernel_folder()
    assert VARIABLE not in os.environ


@pytest.mark.parametrize("said", [None, "/mine"])
def test_where_nothing_can_be_written_it_is_a_temporary_folder(temporary, monkeypatch, said):
    monkeypatch.setattr("geogs.guard.kernel_folder.can_be_written", lambda folder: False)
    if said is not None:
        monkeypatch.setenv(VARIABLE, said)
    else:
        monkeypatch.setenv(VARIABLE, "")  # so that it is put back
        monkeypatch.delenv(VARIABLE)
    find_kernel_folder()
    assert os.environ[VARIABLE] == (said or str(temporary / f"geogs-kernels-{os.getuid()}"))


def test_a_folder_that_is_not_there_can_be_written_where_it_can_be_made(tmp_path):
    assert can_be_written(tmp_path / "a" / "b")
    (tmp_path / "file").touch()
    assert not can_be_written(tmp_path / "file" / "b")


def test_a_folder_of_others_is_not_taken(temporary):
    own = temporary_folder()
    assert stat.S_IMODE(own.stat().st_mode) == 0o700
    assert temporary_folder() == own
    own.chmod(0o777)
    other = temporary_folder()
    assert other != own
    assert stat.S_IMODE(other.stat().st_mode) == 0o700
    own.rmdir()
    own.symlink_to(temporary)
    assert temporary_folder() not in (own, temporary)
