"""Which pictures in a folder are its frames: no depth, no masks, no previews, no kinds not read."""

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

from geogs.io.pictures import upright_size
from geogs.io.sources.account import named
from geogs.io.sources.formats.image_times import time_in

_RIGHT = "the right camera"
_WORDS = {
    "colour": ("color", "colour", "rgb", "image", "img", "left"),
    "depth": ("depth", "depths", "depthmap", "disp", "disparity"),
    "masks": ("mask", "masks", "matte", "alpha", "silhouette"),
    "labels": ("seg", "segmentation", "semantic", "semantics", "instance", "label", "labels"),
    "normals": ("normal", "normals"),
    "confidence": ("conf", "confidence"),
    "infrared": ("ir", "infra", "infrared", "thermal"),
    _RIGHT: ("right",),
    "previews": ("thumb", "thumbs", "thumbnail", "preview", "small"),
}
"""Words in the names of pictures of one moment, by what these show."""
_ROLE = {word: role for role, words in _WORDS.items() for word in words}
_WORD = re.compile(rf"(?<![a-z])({'|'.join(_ROLE)})(?![a-z])", re.IGNORECASE)
_UNREAD = {
    "convert them to JPEG": "heic heif hif jxl gif psd psb jp2 j2k jpx jfif jpe jxr svg ico tga",
    "develop them to JPEG": (
        "3fr arw cr2 cr3 crw dcr dng erf iiq kdc mef mos mrw nef nrw orf pef raf raw rw2 rwl sr2 "
        "srf srw x3f"
    ),
    "give the video itself": "mov mp4 m4v webm mkv avi mts m2ts 3gp wmv",
}
"""Endings of pictures and videos that are not read as frames, by what helps."""
_HELP = {f".{ending}": help for help, endings in _UNREAD.items() for ending in endings.split()}
_LEAST_ALIKE = 5
"""Least number of names of one kind, beside which another kind counts as stray."""
_MOST_STRAY = 0.2
"""Largest number of stray pictures, as a fraction of the others."""
_ASKED = 8
"""Number of pictures whose size tells that a stray one has another."""


def time_from_name(stem: str) -> float | None:
    """Time in seconds that a file name holds; none for an ordinary name or number."""
    return time_in(_WORD.sub("", stem).strip("-_. "))


def frames_among(paths: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """The frames of a recording among pictures, and a sentence on each kind of the others."""
    kept, others = images_among(paths, of_one_camera=True)
    stray = _beside_times(kept) or _beside_numbers(kept)
    if stray:
        others.append(f"{_counted(stray, 'picture')}, not named like the others")
    left = set(stray)
    return [path for path in kept if path not in left], others


def images_among(
    paths: Sequence[Path], of_one_camera: bool = False
) -> tuple[list[Path], list[str]]:
    """The images among pictures, some of which may show depth or masks for them by their names, and
    a sentence on each kind of these.

    Those of a right camera count as such with ``of_one_camera`` alone, and in a row of pairs.
    """
    by_role = defaultdict(list)
    for path in paths:
        by_role[_role(path.stem)].append(path)
    unnamed, coloured = (by_role.pop(role, []) for role in ("", "colour"))
    if not of_one_camera or len(by_role.get(_RIGHT, [])) < _LEAST_ALIKE:
        by_role.pop(_RIGHT, None)
    moments = {_moment(path) for path in unnamed + coloured}
    others = []
    left: set[Path] = set()
    for role, found in by_role.items():
        shown = sum(_moment(path) in moments for path in found)
        if 2 * max(shown, len(coloured)) >= len(found):
            left |= {*found}
            others.append(f"{_counted(found, 'picture')}, of {role} by the names")
    return [path for path in paths if path not in left], others


def unread(names: Iterable[str], kept: Iterable[Path] = ()) -> list[str]:
    """A sentence on each kind of picture that is not read, unless each lies beside one of the same
    name that is kept."""
    stems = {path.stem.lower() for path in kept}
    files = (Path(name) for name in names if not name.startswith("."))
    kinds = Counter(f.suffix.lower() for f in files if f.stem.lower() not in stems)
    return [
        f"{count} {kind} {'file is' if count == 1 else 'files are'} not read here: {_HELP[kind]}"
        for kind, count in sorted(kinds.items())
        if kind in _HELP
    ]


def _role(stem: str) -> str:
    """Content of a picture by the words of its name; empty where none tells it."""
    roles = [_ROLE[word.lower()] for word in _WORD.findall(stem)]
    return next((role for role in roles if role != "colour"), "colour" if roles else "")


def _moment(path: Path) -> tuple[str, ...]:
    """The numbers in a name, without leading zeros; the rest of the name where it has none."""
    numbers = tuple(digits.lstrip("0") or "0" for digits in re.findall(r"\d+", path.stem))
    return numbers or (_WORD.sub("", path.stem).strip("-_. ").lower(),)


def _beside_times(paths: Sequence[Path]) -> list[Path]:
    """Those of other names, and the second of one time, where nearly all names are times."""
    timed = {time_from_name(path.stem): path for path in sorted(paths, reverse=True)}
    timed.pop(None, None)
    return _few(paths, [*timed.values()])


def _beside_numbers(paths: Sequence[Path]) -> list[Path]:
    """Those of another name and another size, where nearly all names differ in numbers alone."""
    kinds = [re.sub(r"\d+", "0", path.stem) for path in paths]
    usual = Counter(kinds).most_common(1)[0][0] if kinds else ""
    alike = [path for path, kind in zip(paths, kinds, strict=True) if kind == usual]
    stray = _few(paths, alike) if "0" in usual else []
    sizes = {upright_size(path) for path in alike[:: len(alike) // _ASKED + 1]} if stray else set()
    words = [path for path in stray if re.search(r"[^\W\d_]{3}", path.stem)]  # no "a" of a series
    return [path for path in words if upright_size(path) not in {None, *sizes}]


def _few(paths: Sequence[Path], alike: Sequence[Path]) -> list[Path]:
    """The paths that are not alike, if they are few beside those that are."""
    rest = len(paths) - len(alike)
    if len(alike) < _LEAST_ALIKE or rest > _MOST_STRAY * len(alike):
        return []
    return sorted(set(paths) - set(alike))


def _counted(paths: Sequence[Path], what: str) -> str:
    names = named([path.name for path in sorted(paths)])
    return f"{len(paths)} {what}{'s' if len(paths) != 1 else ''} ({names})"
