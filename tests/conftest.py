"""Run-time shape checks for the whole suite, what all tests share, and where the shared data is."""

import fcntl
import gc
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import jaxtyping
import pytest
import torch

import lazy_check

SOURCE = Path(__file__).parents[1] / "src"


def _typed_modules() -> list[str]:
    """Every module of ours except compiled kernels, which the type checker must not wrap, and
    settings, which check themselves."""
    names = []
    for path in SOURCE.glob("geogs*/**/*.py"):
        name = ".".join(path.relative_to(SOURCE).with_suffix("").parts)
        left_out = ".splat.cpu." in name or name.startswith("geogs.config.")
        if not name.endswith(("_kernels", "__init__")) and not left_out:
            names.append(name)
    return sorted(names)


gc.disable()  # until everything is imported, which stays
torch.set_num_threads(1)  # as the system works; more only wait for each other
jaxtyping.jaxtyped = lazy_check.jaxtyped  # what the hook decorates with
jaxtyping.install_import_hook(_typed_modules(), "lazy_check.checked")


Once = Callable[[str, Callable[[Path], object]], Path]
"""Folder of a name, which the function given fills for whoever asks first."""


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist asks for the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that share what their module has made go to one process, which makes it once.

    Tests of the whole system come first: the last ones are short, so no process waits for another.
    """
    items.sort(key=lambda item: item.get_closest_marker("system") is None)
    for item in items:
        used = item._fixtureinfo.name2fixturedefs.values()
        if any(made.scope == "module" for definitions in used for made in definitions):
            item.add_marker(pytest.mark.xdist_group(item.nodeid.partition("::")[0]))


def pytest_collection_finish() -> None:
    """What is there by now stays to the end: no collection of garbage looks through it again."""
    gc.freeze()
    gc.enable()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """In tests of the whole system not every call of a function has its types checked."""
    lazy_check.CALLS.begin(all_checked=item.get_closest_marker("system") is None)


@pytest.fixture(autouse=True)
def heeded_signals() -> Iterator[None]:
    """A test gets signals as in a terminal, and so do its processes.

    A script's background ignores SIGINT and nohup SIGHUP, which processes inherit.
    """
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: signal.SIG_DFL}
    ignored = [number for number in usual if signal.getsignal(number) is signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, usual[number])
    yield
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)


@pytest.fixture(scope="session")
def once(tmp_path_factory) -> Once:
    """Folders that are filled once for all tests, those in other processes of pytest-xdist too.

    Nobody may change what is in them.
    """
    top = tmp_path_factory.getbasetemp()
    top = (top.parent if "PYTEST_XDIST_WORKER" in os.environ else top) / "once"

    def folder(name: str, fill: Callable[[Path], object]) -> Path:
        place = top / name
        place.mkdir(parents=True, exist_ok=True)
        with (place / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (place / "done").exists():
                fill(place / name)
                (place / "done").touch()
        return place / name

    return folder


@pytest.fixture(scope="session")
def room(once: Once) -> Path:
    """Sixty frames of a synthetic room with its truth, 256 x 192: for tests of accuracy."""
    return once("room", lambda folder: _write_room(folder, 256, 192))


@pytest.fixture(scope="session")
def small_room(once: Once) -> Path:
    """The same sixty frames at 128 x 96: for tests of how the parts work together."""
    return once("small-room", lambda folder: _write_room(folder, 128, 96))


def _write_room(folder: Path, width: int, height: int) -> None:
    from geogs_synth.sequence.replica_files import write_sequence
    from lit_rooms import lit_room

    write_sequence(folder, 60, width, height, raycaster=lit_room(0))


@pytest.fixture
def no_report(monkeypatch) -> None:
    """Results come without the pictures of the report, which take longer than a small run."""
    for part in ("write_page", "write_pictures"):
        monkeypatch.setattr(f"geogs.application.results.write.{part}", lambda *_: None)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of development sequences; tests that need it are skipped without it."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the development data (../shared/data) is not on this machine")
    return folder
