"""List of sources, each with a unique name, from the user's words."""

import hashlib
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from geogs.errors import InputError
from geogs_fleet.storage import StoragePath

_VIDEO = re.compile(r"\.(3gp|avi|insv|m2ts|m4v|mkv|mov|mp4|mpeg|mpg|mts|webm|wmv)")
"""Endings by which videos in a folder are recognised; a video named itself may have any."""
_TABLES = frozenset({"rgb.txt", "traj.txt"})
"""Files of a data set, which is one source whatever else it contains."""
_PATTERN = re.compile(r"[*?\[]")


@dataclass(frozen=True)
class FleetSource:
    """One video or folder of images."""

    address: str
    """An absolute path, or an address for fsspec."""
    name: str
    """Name of its folder in the results, unique in the fleet."""


def find_sources(given: Sequence[str]) -> list[FleetSource]:
    """Find the sources that words name, each once, in the given order.

    A word is a text file (.txt) with one address a line (empty lines and those that begin with #
    are ignored; paths are relative to the file), a pattern, a folder of videos and of folders of
    images, or a source itself: a video, or any other folder.

    Raises:
        InputError: a word names nothing, or a list cannot be read.
    """
    addresses = list(dict.fromkeys(address for word in given for address in _meant(word)))
    if not addresses:
        raise InputError("No source was found; give videos, folders, a pattern or a list (.txt).")
    stems = [_stem(address) for address in addresses]
    often = Counter(stem.lower() for stem in stems)  # some file systems do not tell a from A
    return [
        FleetSource(address, stem if often[stem.lower()] == 1 else f"{stem}-{_digest(address)}")
        for address, stem in zip(addresses, stems, strict=True)
    ]


def _meant(word: str) -> Iterator[str]:
    place = StoragePath(word)
    path = place.path
    if path is not None and path.is_file() and path.suffix.lower() == ".txt":
        yield from _lines(place, path.absolute().parent)
    elif path is None and word.lower().endswith(".txt"):
        yield from _lines(place, None)
    elif _PATTERN.search(word) and (path is None or not path.exists()):
        found = [StoragePath(address).absolute().address for address in place.matching()]
        if not found:
            raise InputError(f"Nothing fits the pattern {word}; is it right?")
        yield from found
    elif path is not None and not path.exists():
        raise InputError(f"{word} does not exist; give a video, a folder, a pattern or a list.")
    else:
        yield from _inside(place) or [place.absolute().address]


def _lines(place: StoragePath, folder: Path | None) -> Iterator[str]:
    text = place.read()
    if text is None:
        raise InputError(f"{place.address} does not exist; give a list that does.")
    for line in map(str.strip, text.splitlines()):
        if line and not line.startswith("#"):
            path = StoragePath(line).path
            yield line if path is None or folder is None else str((folder / path).absolute())


def _inside(place: StoragePath) -> list[str]:
    """Sources in a folder; empty if it is a source itself."""
    listed = {name: kind for name, kind in place.listed().items() if not name.startswith(".")}
    folders = [name for name, is_folder in listed.items() if is_folder]
    plain = [name for name, is_folder in listed.items() if not is_folder]
    videos = [name for name in plain if _VIDEO.fullmatch(_suffix(name))]
    is_data_set = not _TABLES.isdisjoint(plain)
    if is_data_set or (not videos and (plain or not folders)):
        return []
    return [(place / name).absolute().address for name in sorted([*videos, *folders])]


def _stem(address: str) -> str:
    """A plain name for a folder, from the last part of an address."""
    name = StoragePath(address.rstrip("/")).name
    stem = name[: -len(_suffix(name))] if _VIDEO.fullmatch(_suffix(name)) else name
    return re.sub(r"[^\w.-]+", "_", stem).strip("._-") or "source"


def _suffix(name: str) -> str:
    return PurePosixPath(name).suffix.lower()


def _digest(address: str) -> str:
    return hashlib.sha256(address.encode("utf-8", "backslashreplace")).hexdigest()[:8]
