"""Files and folders named by settings, and the check of those named by a checkpoint."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

from geogs.config.leaves import Leaf, leaves, with_values
from geogs.config.setting import NamesFile, Positional
from geogs.guard.documents import expanded
from geogs.io.sources.address import live_address

S = TypeVar("S")


def with_absolute_paths(settings: S) -> S:
    """The same settings with absolute paths."""

    def absolute(name: str | Path) -> str | Path:
        return name if live_address(name) else type(name)(expanded(name).absolute())

    found: dict[tuple[str, ...], object] = {}
    for leaf in _naming(settings):
        each = tuple(map(absolute, _names(leaf)))
        found[leaf.path] = each if leaf.kind.is_tuple else each[0]
    return with_values(settings, found)


def without_files_outside(settings: S, folder: Path) -> S:
    """The same settings, with defaults in place of names outside a folder."""
    found = dict[tuple[str, ...], object]()
    usual = {leaf.path: leaf.default for leaf in leaves(type(settings))}
    for leaf in _naming(settings):
        if not all(_is_inside(name, folder) for name in _names(leaf)):
            found[leaf.path] = usual[leaf.path]
    return with_values(settings, found)


def with_files_of(settings: S, others: S) -> S:
    """The same settings with the paths of ``others``: for the source, which is checked by its
    fingerprint, and for files of the same name in other folders."""
    theirs = {leaf.path: leaf for leaf in _naming(others)}
    found = dict[tuple[str, ...], object]()
    for leaf in _naming(settings):
        other = theirs.get(leaf.path)
        is_source = leaf.mark(Positional) is not None
        if other is not None and (is_source or _last(leaf) == _last(other)):
            found[leaf.path] = other.default
    return with_values(settings, found)


def options_missing(settings: object, wanted: object) -> list[str]:
    """Options that name files in ``wanted`` but not in ``settings``."""
    here = {leaf.path for leaf in _naming(settings)}
    return [_option(leaf) for leaf in _naming(wanted) if leaf.path not in here]


def _names(leaf: Leaf) -> tuple[str | Path, ...]:
    """The names that a setting holds."""
    names: tuple[str | Path, ...] = leaf.default if leaf.kind.is_tuple else (leaf.default,)
    return names


def _naming(settings: object) -> Iterator[Leaf]:
    """The settings that name a file or folder."""
    for leaf in leaves(settings):
        if leaf.kind.base is Path:
            names_any = leaf.default not in (None, ())
        else:
            mark: NamesFile | None = leaf.mark(NamesFile)
            names_any = mark is not None and _names_file(leaf.default, mark.words)
        if names_any:
            yield leaf


def _names_file(text: str, words: tuple[str, ...]) -> bool:
    """Whether a text is the name of a file, existing or not, rather than another word."""
    is_word = not text or text.strip().lower() in words
    return not is_word and (os.sep in text or "\0" in text or os.path.lexists(expanded(text)))


def _is_inside(name: str | Path, folder: Path) -> bool:
    """Whether a name leads into a folder; nothing outside is accessed."""
    if live_address(name) is not None:
        return False
    said, here = (Path(os.path.abspath(expanded(path))) for path in (name, folder))
    return said.is_relative_to(here) and said.resolve().is_relative_to(here.resolve())


def _last(leaf: Leaf) -> list[str]:
    """The names without the folders."""
    return [Path(name).name for name in _names(leaf)]


def _option(leaf: Leaf) -> str:
    """A setting as written on the command line."""
    is_first = leaf.mark(Positional) is not None
    return leaf.name.upper() if is_first else f"{leaf.options[-1]} {leaf.path[-1].upper()}"
