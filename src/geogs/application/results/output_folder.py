"""The folder of a result: which is free, who may write there, what of a previous output goes."""

import fcntl
import os
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from geogs.documents import read_json
from geogs.errors import InputError, OutputError
from geogs.io.writers.atomic import prepare_output_folder

_FILES = (
    "summary.json", "eval.json", "trajectory.tum", "keyframes.tum", "trajectory_uncertainty.csv",
    "orientations.tum", "intrinsics.json", "config.yaml", "mesh.ply", "splats.ply",
    "map.safetensors", "depth_fusion/mesh.ply",
)  # fmt: skip
"""In the order in which they go: the summary first, so that no half of a result has one."""
_STAGES = ("online", "adjusted")
_OF_A_STAGE = ("trajectory.tum", "orientations.tum", "keyframes.tum", "mesh.ply")
_KEYFRAME = re.compile(r"\d{6,}\.(jpg|mask\.png)|rows\.safetensors")
_REPORT = re.compile(r"\w+\.(png|html|css|js)")
LOCK = ".geogs.lock"
"""Name of the file that is locked."""


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Inside, nobody else who asks likewise writes into a folder, where that can have locks.

    Raises:
        OutputError: another process writes there.
    """
    path = folder / LOCK
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
    except OSError:
        yield
        return
    try:
        if not _is_locked(file, path):
            raise OutputError(
                f"Another run is writing into {folder}; wait for it, or give another folder (-o)."
            )
        try:
            yield
        finally:
            with suppress(OSError):
                path.unlink()
    finally:
        os.close(file)


def _is_locked(file: int, path: Path) -> bool:
    """Whether the file is ours now, and still the one of that name."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False


@contextmanager
def claimed(folder: Path) -> Iterator[Path]:
    """The folder of a result, made where there is none; inside, nobody else writes there.

    Raises:
        OutputError: it cannot be made or written, or another process writes there.
    """
    output = prepare_output_folder(folder)
    with only_writer(output):
        yield output


def remove_previous_output(folder: Path, new_stages: Collection[str] = ()) -> None:
    """Delete the files of a previous output, so that none stays beside those of a new one.

    Only files of names that geogs gives are touched; exports and what others put there stay, and
    the folders of stages that are of the new result already.
    """
    stages = [
        f"{stage}/{name}" for stage in _STAGES for name in _OF_A_STAGE if stage not in new_stages
    ]
    for name in (*_FILES, *stages):
        _delete(folder / name)
    for inner, names in (("keyframes", _KEYFRAME), ("report", _REPORT)):
        place = folder / inner
        if place.is_dir() and not place.is_symlink():
            for path in list(place.iterdir()):
                if names.fullmatch(path.name):
                    _delete(path)
    for inner in ("depth_fusion", *_STAGES, "keyframes", "report"):
        with suppress(OSError):  # not empty, or not there
            (folder / inner).rmdir()


def free_folder(wanted: Path, fingerprint: str) -> Path:
    """The folder, or the next of its name with a number that holds no result of another source.

    ``fingerprint`` distinguishes sources of one name.
    """
    for number in count(1):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
        if not _is_of_another(folder, fingerprint):
            return folder
    raise AssertionError("count never ends")


def _is_of_another(folder: Path, fingerprint: str) -> bool:
    if not folder.is_dir():
        return False
    from geogs.application.checkpoints.checkpoint import has_checkpoint

    try:
        summary = read_json(folder / "summary.json")
    except InputError:
        return has_checkpoint(folder) and _begun_with(folder) not in (None, fingerprint)
    return not isinstance(summary, dict) or summary.get("fingerprint") != fingerprint


def _begun_with(folder: Path) -> str | None:
    """The source of an unfinished run; none where that is not known."""
    from geogs.application.checkpoints.run_state import SavedRun

    try:
        return SavedRun(folder).metadata.fingerprint
    except InputError:
        return None


def _delete(path: Path) -> None:
    with suppress(OSError):
        path.unlink()
