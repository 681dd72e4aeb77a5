"""Find the files that a list of another program names, as they lie on this machine."""

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from geogs.io.sources.account import Account

IMAGE_FOLDERS = (
    *("images", "image", "rgb", "color", "frames", "input", "resized_images", "original_images"),
)
"""Folders in which programs put the images of a project."""
_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".ppm", ".pgm")
"""Suffixes that a name without one may stand for, the first before the others."""


class NamedFiles:
    """Finds named files below some folders.

    A name is first taken as it is. Else back slashes separate folders, too; leading folders that
    are not here, such as those of another machine, are left out; letters may be composed
    otherwise (NFD, NFC) or be upper or lower case; and the suffix may be missing, or another where
    the folder has no file with that one. No such name leads out of the folders.
    """

    def __init__(self, *folders: Path) -> None:
        self._folders = tuple(dict.fromkeys(folders))
        self._listed: dict[Path, dict[str, list[str]]] = {}

    def find(self, names: Sequence[str]) -> list[Path | None]:
        """The file of each name; none where there is none, or where it would not be exact and
        would be that of another name, too."""
        exact = {name: self._exact(name) for name in names}
        guessed = {name: self._guess(name) for name, file in exact.items() if file is None}
        counts = Counter([*exact.values(), *guessed.values()])
        return [
            exact[name] or (guessed[name] if counts[guessed[name]] == 1 else None) for name in names
        ]

    def _exact(self, name: str) -> Path | None:
        places = (folder / name for folder in self._folders if "\0" not in name)
        return next((place for place in places if place.is_file()), None)

    def _guess(self, name: str) -> Path | None:
        """The file of the longest tail of a name that is here."""
        parts = _parts(name)
        tails = (parts[start:] for start in range(len(parts)))
        found = (self._below(folder, tail) for tail in tails for folder in self._folders)
        return next((file for file in found if file is not None), None)

    def _below(self, folder: Path, parts: Sequence[str]) -> Path | None:
        """The file of a relative name in a folder."""
        *folders, last = parts
        for part in folders:
            name = self._alike(folder, part)
            if name is None:
                return None
            folder = folder / name
        file = self._first(folder, [last, *(last + suffix for suffix in _SUFFIXES)])
        stem, own = os.path.splitext(last)
        if file or not own or any(entry.endswith(_key(own)) for entry in self._entries(folder)):
            return file
        return self._first(folder, [stem + suffix for suffix in _SUFFIXES])

    def _first(self, folder: Path, names: Sequence[str]) -> Path | None:
        found = (folder / alike for name in names if (alike := self._alike(folder, name)))
        return next((file for file in found if file.is_file()), None)

    def _alike(self, folder: Path, name: str) -> str | None:
        """The entry of a folder that a name stands for; none where several are equally like it."""
        alike = self._entries(folder).get(_key(name), [])
        same = [entry for entry in alike if _composed(entry) == _composed(name)] or alike
        return name if name in same else same[0] if len(same) == 1 else None

    def _entries(self, folder: Path) -> dict[str, list[str]]:
        """Names in a folder by their keys, read once."""
        if folder not in self._listed:
            entries = self._listed.setdefault(folder, {})
            names = os.listdir(folder) if folder.is_dir() and os.access(folder, os.R_OK) else []
            for name in names:
                entries.setdefault(_key(name), []).append(name)
        return self._listed[folder]


def root_above(folder: Path, way: Path) -> Path | None:
    """The folder from which a relative way leads to ``folder``; none if its end is another."""
    folder = folder.absolute()
    count = len(way.parts)
    is_end = count > 0 and folder.parts[-count:] == way.parts
    return folder.parents[count - 1] if is_end else None


def elsewhere(names: Sequence[str], files: Sequence[Path | None]) -> Account:
    """An account of the files that lie in other folders, or have another suffix, than named."""
    pairs = zip(names, files, strict=True)
    others = [file for name, file in pairs if file and not _is_as_named(file, name)]
    return Account(used=_counted("images that lie elsewhere than listed", others))


def unlisted(files: Sequence[Path | None]) -> Account:
    """An account of the pictures in the folders of listed files that are not listed."""
    listed = {file for file in files if file is not None}
    folders = {file.parent for file in listed}
    beside = {folder / name for folder in folders for name in os.listdir(folder)}
    others = sorted(file for file in beside - listed if file.suffix.lower() in _SUFFIXES)
    return Account(left=_counted("pictures that are not listed", others))


def _counted(what: str, files: Sequence[Path]) -> tuple[str, ...]:
    return (f"{what}: {len(files)}, such as {files[0]}",) if files else ()


def _is_as_named(file: Path, name: str) -> bool:
    named = _key("/".join(_parts(name)))
    return any(_key(path.as_posix()).endswith(named) for path in (file, file.with_suffix("")))


def _parts(name: str) -> list[str]:
    """Folders and name of a file as another machine names it, what is before ``..`` left out."""
    parts = re.sub(r"^\s*[A-Za-z]:", "", name).strip().replace("\\", "/").split("/")
    if ".." in parts:
        parts = parts[len(parts) - parts[::-1].index("..") :]
    return [part for part in parts if part not in ("", ".")]


def _composed(name: str) -> str:
    return unicodedata.normalize("NFC", name)


def _key(name: str) -> str:
    """A name as file systems compare it that do not tell upper from lower case."""
    return _composed(name).casefold()
