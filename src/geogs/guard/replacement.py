"""Replacement of all files of a command together, or of none.

New files are written into a new folder beside the old ones, which has no links in it. Until the
last of them is on the disk nothing else is touched; if the disk is full or the command ends before,
that folder is deleted, and all is as it was. Then

1. the folders that the files need are made, or checked to be folders and no links,
2. the new folder is renamed from ``.geogs.N.new`` to ``.geogs.N.ready``, which commits it,
3. every file is renamed into its place, files of the previous result that the new one has no others
   for are deleted, and last the list of the result's files is renamed into its place.

A process that is killed before the second step leaves a folder that the next command deletes; one
that is killed after it a folder whose files the next command puts into their places: each part of
the third step may be done twice. It needs hardly any space, as files are only renamed.

Other programs see each file whole, old or new, and during the third step some old beside some new
ones. (A link to the folder of the current result would avoid that, but not all disks have links,
and copies of the folder would be of the link.) Nothing of geogs reads such a mixture.

The list ``.geogs.json`` says which files may be deleted: names and SHA-256 of the result's files.
It is not trusted: names in it cannot lead out of the folder, and a file with other
content stays. N in the names of new folders is their inode number, so that a copied folder does not
count as one of ours.
"""

import json
import os
import re
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from typing import Literal

from geogs.errors import OutputError
from geogs.guard.atomic import unwritable, write_text
from geogs.guard.directory import Directory
from geogs.guard.documents import UNUSABLE

LIST = ".geogs.json"
"""Name of the list of a result's files."""
_NEW = re.compile(r"\.geogs\.(\d{1,20})\.(new|ready)")
_MARKS = ("summary.json", "map.safetensors")
"""Files of every result, which identify one without a list."""
_OTHERS = (
    "config.yaml intrinsics.json keyframes.tum mesh.ply splats.ply trajectory.tum "
    "trajectory_uncertainty.csv"
)
_FILES = (*_MARKS, *_OTHERS.split())
"""Files that a result may need, checked before the work begins."""
_FOLDERS = ("adjusted", "depth_fusion", "keyframes", "online", "report", "snapshots")
"""Folders that a result may need, checked before the work begins."""
_LARGEST_LIST = 1 << 26
"""Largest list in bytes; it has about a hundred for every file."""

Extent = Literal["result", "part", "beside"]
"""A whole result, which replaces the previous one; some files of the existing one; or files that no
later result replaces, such as exports."""


@contextmanager
def replaced(folder: Path, what: Extent, without: Collection[str] = ()) -> Iterator[Path]:
    """Yield a folder for new files; they move into place when the block ends without an error.

    No other process may write there meanwhile. Files keep the names of the new folder. All goes to
    the folder that had the name at the beginning. Files of the existing result ``without`` which
    the new part is are deleted, if nobody has changed them.

    Raises:
        OutputError: something cannot be written, a link or something else is in the way, a result
            would replace one that has no list of its files, or another folder has got the name.
    """
    with ExitStack() as handle:
        with _sentence(folder):
            place = handle.enter_context(Directory.opened(folder))
            if what == "result":
                _check(place)
            new = _begun(place)
        unfinished = place.reach / new
        try:
            yield unfinished
        except BaseException as error:
            with suppress(OSError):
                place.delete_all(new)
            if isinstance(error, OutputError):  # its final path, not the temporary one
                final = str(error).replace(str(unfinished), str(folder))
                raise OutputError(final.replace(new + os.sep, "")) from error
            raise
        with _sentence(folder):
            _put_in_place(place, _committed(place, new, what, without))
        if not place.is_at_its_path():
            where = os.path.realpath(place.reach)
            raise OutputError(
                f"{folder} is another folder than at the beginning; the files are in {where}."
            )


def is_half_done(folder: Path) -> bool:
    """Whether a command was interrupted there while it moved new files into place."""
    with suppress(OSError), Directory.opened(folder) as place:
        return any(name.endswith(".ready") for name in _ours(place))
    return False


def recover(folder: Path) -> None:
    """Complete or undo an interrupted write; no other process may write there meanwhile.

    Raises:
        OutputError: that cannot be done.
    """
    with _sentence(folder), Directory.opened(folder) as place:
        for name in _ours(place):
            if name.endswith(".ready"):
                _put_in_place(place, name)
            else:
                place.delete_all(name)


def _check(place: Directory) -> None:
    """Raise the errors of writing a whole result early."""
    for name in _FILES:
        _require_no_folder(place, name)
    names = place.names()
    listed = _listed(place)
    if any(mark in names and mark not in listed for mark in _MARKS):
        raise OutputError(
            f"{place.path} holds a result that has no list of its files ({LIST}), as an earlier "
            "geogs wrote it: delete it, or give another folder (-o)."
        )
    for name in _FOLDERS:
        if name in names:
            with place.inner(name):
                pass


def _require_no_folder(place: Directory, name: str) -> None:
    if place.is_folder(name):
        raise OutputError(
            f"{place.path / name} is a folder, and a file is to be there; move it away, or give "
            "another folder (-o)."
        )


def _begun(place: Directory) -> str:
    """Make a folder for new files. Returns its name."""
    name = f".geogs.{token_hex(6)}.part"
    place.make(name)
    new = f".geogs.{place.number(name)}.new"
    place.move(name, place, new)
    return new


def _ours(place: Directory) -> list[str]:
    """Folders of new files in this folder, without copied ones."""
    found = [match for name in place.names() if (match := _NEW.fullmatch(name))]
    return [match[0] for match in found if place.number(match[0]) == int(match[1])]


def _committed(place: Directory, new: str, what: Extent, without: Collection[str]) -> str:
    """Do the first and second step. Returns the name of the committed folder."""
    made: list[str] = []
    try:
        with place.inner(new) as files:
            if what != "beside":
                own = {name: files.sha256(name) for name in files.files()}
                former = {} if what == "result" else _listed(place)
                listed = {k: v for k, v in former.items() if k not in without} | own
                text = json.dumps({"files": listed}, indent=0, sort_keys=True)
                write_text(files.reach / LIST, text + "\n")
            for folder in files.folders():
                if place.make(folder):
                    made.append(folder)
            for name in files.files():
                _require_no_folder(place, name)
        ready = new.replace(".new", ".ready")
        place.move(new, place, ready)
    except BaseException:
        place.delete_all(new)
        with suppress(OSError):
            for folder in reversed(made):
                place.delete_empty(folder)
        raise
    place.sync()
    return ready


def _put_in_place(place: Directory, ready: str) -> None:
    """Do the third step, or its rest."""
    try:
        _move_all(place, ready)
    except OSError as error:
        raise OutputError(
            f"Some files of {place.path} are new and some old ({error.strerror or error}); the "
            "next command there puts the others into their places."
        ) from error


def _move_all(place: Directory, ready: str) -> None:
    with place.inner(ready) as new:
        for folder in new.folders():
            place.make(folder)
        names = [name for name in new.files() if name != LIST]
        # The summary comes last: other programs wait for it.
        for name in sorted(names, key=lambda name: name == "summary.json"):
            new.move(name, place, name)
        if LIST in new.names():
            listed = _listed(place)
            for name in listed.keys() - _listed(new).keys():
                with suppress(OSError):  # missing, or not written by geogs
                    if place.sha256(name) == listed[name]:
                        place.delete(name)
            new.move(LIST, place, LIST)
    place.delete_all(ready)


def _listed(place: Directory) -> dict[str, str]:
    """Names and digests of the files of a result; none where there is no list."""
    try:
        files = json.loads(place.read(LIST, _LARGEST_LIST))["files"]
        return {str(name): str(digest) for name, digest in files.items()}
    except (OSError, *UNUSABLE):
        return {}


@contextmanager
def _sentence(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise unwritable(folder, error) from error
