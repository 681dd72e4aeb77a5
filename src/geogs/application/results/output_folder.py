"""What an earlier run left in a folder: where it may be replaced, and what goes with it."""

import re
from collections.abc import Collection
from contextlib import suppress
from itertools import count
from pathlib import Path

from geogs.application.checkpoints.checkpoint import has_checkpoint
from geogs.documents import read_json
from geogs.errors import InputError

_FILES = (
    "summary.json", "eval.json", "trajectory.tum", "keyframes.tum", "trajectory_uncertainty.csv",
    "intrinsics.json", "config.yaml", "mesh.ply", "splats.ply", "map.safetensors",
    "depth_fusion/mesh.ply",
)  # fmt: skip
"""In the order in which they go: the summary first, so that no half of a result has one."""
_STAGES = ("online", "adjusted")
_OF_A_STAGE = ("trajectory.tum", "keyframes.tum", "mesh.ply")
_KEYFRAME = re.compile(r"\d{6,}\.(jpg|mask\.png)|rows\.safetensors")
_REPORT = re.compile(r"\w+\.(png|html|css|js)")


def remove_former(folder: Path, new_stages: Collection[str] = ()) -> None:
    """Delete the files of an earlier result, so that none stays beside those of a new one.

    Only files of names that geogs gives are touched; exports and what others put there stay, and
    the folders of stages that are of the new result already.
    """
    former = [
        f"{stage}/{name}" for stage in _STAGES for name in _OF_A_STAGE if stage not in new_stages
    ]
    for name in (*_FILES, *former):
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

    ``fingerprint`` tells sources of one name apart.
    """
    for number in count(1):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
        if not _is_of_another(folder, fingerprint):
            return folder
    raise AssertionError("count never ends")


def _is_of_another(folder: Path, fingerprint: str) -> bool:
    if not folder.is_dir():
        return False
    try:
        summary = read_json(folder / "summary.json")
    except InputError:
        return has_checkpoint(folder) and _begun_with(folder) not in (None, fingerprint)
    return not isinstance(summary, dict) or summary.get("fingerprint") != fingerprint


def _begun_with(folder: Path) -> str | None:
    """The source of an unfinished run; none where that cannot be told."""
    from geogs.application.checkpoints.run_state import SavedRun

    try:
        return SavedRun(folder).facts.fingerprint
    except InputError:
        return None


def _delete(path: Path) -> None:
    with suppress(OSError):
        path.unlink()
