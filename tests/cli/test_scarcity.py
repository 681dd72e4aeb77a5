"""Too little memory, too few files, no home, no cache, an old locale: it works, or says so."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

import geogs as geogs_package
from geogs.cli import command
from geogs.cli import main as cli
from geogs.cli.command import COMMANDS, Command
from geogs.guard.kernel_folder import VARIABLE

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
GEOGS = f"{sys.executable} -m geogs.cli.main"


def geogs(words: str, before: str = "", **variables: str | None) -> subprocess.CompletedProcess:
    """Run a command in a shell that has done something before, with variables set or taken away."""
    environment = {**ENVIRONMENT, **variables}
    environment = {name: value for name, value in environment.items() if value is not None}
    return subprocess.run(
        ["bash", "-c", f"{before}\n{GEOGS} {words}"],
        env=environment, capture_output=True, timeout=1800, check=False,
    )  # fmt: skip


def failing_with(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a command end with an error of the system."""

    def main(argv: object) -> int:
        raise error

    module = type("Module", (), {"main": staticmethod(main)})
    monkeypatch.setattr(command.importlib, "import_module", lambda name: module)
    monkeypatch.setitem(COMMANDS, "fail", Command("nowhere", "fails"))


class OutOfMemoryError(RuntimeError):
    """As PyTorch calls it."""


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "The memory is full"),
        (RuntimeError("can't start new thread"), "The memory is full"),
        (ImportError("libtorch.so: failed to map segment"), "The memory is full"),
        (OSError(errno.EMFILE, "Too many open files"), "Too many files are open; raise the limit"),
        (OSError(errno.ENOSPC, "No space left on device"), "A disk is full (that of the results,"),
        (OSError(errno.ENAMETOOLONG, "File name too long", "/x" * 2500), "/x/x/x/x/x/x/x/x/x/"),
        (OutOfMemoryError("CUDA out of memory. Tried"), "The GPU failed (CUDA out of memory"),
        (RuntimeError("CUDA error: unspecified launch failure\nmore"), "The GPU failed (CUDA err"),
        (RuntimeError("cannot cache function 'f': no locator available"), "No folder can be"),
    ],
)  # fmt: skip
def test_what_the_system_lacks_is_one_sentence(error, said, monkeypatch, capsys):
    failing_with(error, monkeypatch)
    assert cli.main(["fail"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {said}")
    assert len(line) < 300
    assert line.endswith(".")


def test_errors_of_ours_keep_their_traceback(monkeypatch):
    failing_with(RuntimeError("shapes do not fit"), monkeypatch)
    with pytest.raises(RuntimeError, match="shapes"):
        cli.main(["fail"])


@pytest.mark.parametrize("kibibytes", [300_000, 500_000])  # the second loads half of all
def test_too_little_address_space_is_one_sentence(kibibytes):
    done = geogs("doctor", f"ulimit -v {kibibytes}")
    assert done.returncode == 2
    assert done.stderr.decode().startswith("error: The memory is full")
    assert b"Traceback" not in done.stderr


@pytest.mark.system
def test_few_file_handles_are_enough_for_a_sentence():
    done = geogs("run /no/such/video.mp4", "ulimit -n 5")
    assert done.returncode == 2
    assert b"Traceback" not in done.stderr
    assert done.stderr.decode().splitlines()[-1].startswith("error: ")


@pytest.mark.system
def test_without_a_home_and_a_terminal():
    done = geogs("run /no/such/video.mp4", HOME=None, TERM=None, USER=None, LOGNAME=None)
    assert done.returncode == 2
    (line,) = done.stderr.decode().splitlines()
    assert line.startswith("error: /no/such/video.mp4 does not exist")


@pytest.mark.long
def test_where_only_results_can_be_written_a_scene_is_rendered(tmp_path):
    """Neither the program's folder, nor the home, nor /dev/shm: as in many containers.

    Kernels are compiled anew; tests/guard/test_kernel_folder.py looks at where they are kept.
    """
    if subprocess.run(["unshare", "-m", "true"], capture_output=True, check=False).returncode:
        pytest.skip("the system lets nobody change what is mounted")
    source = Path(geogs_package.__file__).parent
    home, out = tmp_path / "home", tmp_path / "out"
    home.mkdir()
    mounts = (
        f"mount --bind {source} {source} && mount -o remount,ro,bind {source}",
        f"mount -t tmpfs -o ro,size=4k none {home}",
        "mount -t tmpfs -o ro,size=4k none /dev/shm",
    )
    words = f"{GEOGS} synth {out} --frames 2 --width 64 --height 48 --no-depth"
    environment = {**ENVIRONMENT, "HOME": str(home), "TMPDIR": str(tmp_path)}
    environment = {k: v for k, v in environment.items() if k not in ("XDG_CACHE_HOME", VARIABLE)}
    done = subprocess.run(
        ["unshare", "-m", "bash", "-c", " && ".join([*mounts, words])],
        env=environment, capture_output=True, timeout=1800, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode()
    assert any((tmp_path / f"geogs-kernels-{os.getuid()}").iterdir())


@pytest.mark.parametrize("name", ["LC_ALL", "LANG"])
def test_names_in_an_old_locale_are_escaped(tmp_path, name):
    (tmp_path / "räum").mkdir()
    done = geogs(
        f"weights verify '{tmp_path}/räum'", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0",
        **{"LC_ALL": None, "LC_CTYPE": None, name: "C"},
    )  # fmt: skip
    assert done.returncode == 2
    assert b"Traceback" not in done.stderr
    assert done.stderr.isascii()
    assert b"r\\xe4um" in done.stderr or b"r\\udcc3\\udca4um" in done.stderr
