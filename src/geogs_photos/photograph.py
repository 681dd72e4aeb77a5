"""Photographs in a folder, with their sizes and cameras."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from PIL.ExifTags import IFD, Base

from geogs.errors import InputError
from geogs.io.pictures import header_read, size_and_turns
from geogs.io.sources.account import Account
from geogs.io.sources.formats.chosen_pictures import images_among, unread
from geogs.io.sources.formats.image_files import SUFFIXES, image_folder, natural_key, without_images


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
    account: Account = field(default_factory=Account)
    """Pictures of kinds that are not read, or that are depth or masks."""


def find_photographs(folder: str | Path) -> PhotoFolder:
    """Find the photographs in a folder, in its subfolder of images, or in all folders below it.

    Raises:
        InputError: there are none.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; --sfm needs a folder of photographs.")
    root = image_folder(folder)
    files = [path for path in (root.iterdir() if root else folder.rglob("*")) if path.is_file()]
    root = root or folder
    paths, others = images_among(_pictures(files))
    others += unread((path.name for path in files), paths)
    found = [(path, _photograph(path, root)) for path in paths]
    good = tuple(photograph for _, photograph in found if photograph is not None)
    damaged = tuple(_name(path, root) for path, photograph in found if photograph is None)
    if not good:
        raise InputError(
            without_images(folder)
            or f"{folder} holds no photographs that can be read ({', '.join(sorted(SUFFIXES))})."
        )
    return PhotoFolder(root, good, damaged, Account(left=tuple(others)))


def _pictures(paths: Iterable[Path]) -> list[Path]:
    kept = [
        path for path in paths if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
    ]
    return sorted(kept, key=lambda path: (natural_key(str(path)), str(path)))


def _name(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix()


def _photograph(path: Path, root: Path) -> Photograph | None:
    """Read the header of a picture; none if it is damaged."""
    try:
        with header_read(path) as picture:
            (width, height), turns = size_and_turns(picture)
            base = picture.getexif()
            exif = base.get_ifd(IFD.Exif)
            own = [base.get(Base.Make), base.get(Base.Model)]
            tags = (Base.LensModel, Base.FocalLength, Base.FocalLengthIn35mmFilm)
            own += [exif.get(tag) for tag in tags]
            words = tuple("" if w is None else str(w).strip("\0 ") for w in own)
    except Exception:  # any error of the many readers on a damaged file
        return None
    return Photograph(path, _name(path, root), Lens(width, height, words), turns)
