"""Photographs in a folder, with their sizes and cameras."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from geogs.errors import InputError
from geogs.io.pictures import header_read
from geogs.io.sources.formats.image_files import SUFFIXES, image_folder, natural_key

_MAKE, _MODEL, _ORIENTATION, _EXIF_IFD = 0x010F, 0x0110, 0x0112, 0x8769
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM, _LENS_MODEL = 0x920A, 0xA405, 0xA434
_QUARTER_TURNS = {6: 1, 7: 1, 3: 2, 4: 2, 8: 3, 5: 3}
"""Number of clockwise quarter turns to the upright picture, by EXIF orientation."""


@dataclass(frozen=True, slots=True)
class Lens:
    """Camera of a picture by its header; pictures with equal headers have the same intrinsics."""

    width: int
    height: int
    """Size of the picture as it is stored, pixels."""
    words: tuple[str, ...] = ()
    """Make, model, lens and focal lengths from the EXIF."""


@dataclass(frozen=True, slots=True)
class Photograph:
    """A picture on disk, in its stored orientation."""

    path: Path
    name: str
    """Path relative to the folder, with slashes."""
    lens: Lens
    quarter_turns: int = 0
    """Number of clockwise quarter turns from the stored picture to the upright one."""


@dataclass(frozen=True, slots=True)
class PhotoFolder:
    """A folder of photographs."""

    root: Path
    """Folder to which the names of the pictures are relative."""
    photographs: tuple[Photograph, ...]
    """In natural order of their names."""
    damaged: tuple[str, ...]
    """Names of picture files that cannot be read."""


def find_photographs(folder: str | Path) -> PhotoFolder:
    """Find the photographs in a folder, in its subfolder of images, or in all folders below it.

    Raises:
        InputError: there are none.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; --poses auto needs a folder of photographs.")
    root = image_folder(folder)
    paths = _pictures(root.iterdir() if root else folder.rglob("*"))
    root = root or folder
    found = [(path, _photograph(path, root)) for path in paths]
    good = tuple(photograph for _, photograph in found if photograph is not None)
    damaged = tuple(_name(path, root) for path, photograph in found if photograph is None)
    if not good:
        raise InputError(
            f"{folder} holds no photographs that can be read ({', '.join(sorted(SUFFIXES))})."
        )
    return PhotoFolder(root, good, damaged)


def _pictures(paths: Iterable[Path]) -> list[Path]:
    kept = [
        path
        for path in paths
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()
    ]
    return sorted(kept, key=lambda path: (natural_key(str(path)), str(path)))


def _name(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix()


def _photograph(path: Path, root: Path) -> Photograph | None:
    """Read the header of a picture; none if it is damaged."""
    try:
        with header_read(path) as picture:
            width, height = picture.size
            base = picture.getexif()
            exif = base.get_ifd(_EXIF_IFD)
            own = [base.get(_MAKE), base.get(_MODEL)]
            own += [exif.get(tag) for tag in (_LENS_MODEL, _FOCAL_LENGTH, _FOCAL_LENGTH_35MM)]
            words = tuple("" if w is None else str(w).strip("\0 ") for w in own)
            turns = _turns(base)
    except Exception:  # any error of the many readers on a damaged file
        return None
    return Photograph(path, _name(path, root), Lens(width, height, words), turns)


def _turns(exif: Mapping[int, object]) -> int:
    orientation = exif.get(_ORIENTATION)
    return _QUARTER_TURNS.get(orientation, 0) if isinstance(orientation, int) else 0
