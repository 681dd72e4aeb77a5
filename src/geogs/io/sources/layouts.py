"""Find the images of a sequence in a data set by content, one level up or down too."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from geogs.errors import InputError
from geogs.io.sources.formats.image_files import Place, has_images
from geogs.io.sources.named_files import root_above
from geogs.io.sources.posed.posed_set import PosedSet
from geogs.io.sources.reader import Reader

_MOST_FOLDERS = 200
"""Largest number of sub-folders searched for a sequence."""
_NAMED = 5
"""Largest number of sequences that a message names."""


@dataclass(frozen=True)
class Layout:
    """Files and folders of a data set."""

    name: str
    """Name of the data set, for messages."""
    is_like: Callable[[Path], object] | None
    """Test whether a folder is a sequence; none: one of ``pictures`` must have images."""
    open: Callable[[Place], Reader]
    pictures: tuple[str, ...] = ()
    """Folders of images in a sequence, of one camera each; the first that exists is used, unless
    another is given."""
    signs: tuple[str, ...] = ()
    """Patterns of files that identify the data set where the images are missing."""
    needs: str = ""
    """Missing part where only ``signs`` are found, for messages."""
    posed: Callable[[Place], PosedSet] | None = None
    """Reads the images with their true poses; raises InputError where these are missing."""

    def holds(self, folder: Path) -> bool:
        """Whether a folder is a sequence."""
        if self.is_like is None:
            return any(has_images(folder / name) for name in self.pictures)
        return bool(self.is_like(folder))

    def place_in(self, folder: Path) -> Place | None:
        """The sequence of a folder, which may be one of its folders of images; none if neither."""
        if self.holds(folder):
            found = (folder / name for name in self.pictures)
            return Place(folder, next((p for p in found if has_images(p)), folder))
        # ``folder`` may be the folder of images itself, or one on the way to it.
        ways = ((name, way) for name in self.pictures for way in (Path(name), *Path(name).parents))
        places = ((root, root / name) for name, way in ways if (root := root_above(folder, way)))
        found_places = (Place(*p) for p in places if has_images(p[1]) and self.holds(p[0]))
        return next(found_places, None)


def found_in(folder: Path, layouts: Sequence[Layout]) -> tuple[Layout, Place] | None:
    """The first layout that fits a folder, or the sequence that the folder is part of."""
    return next(((layout, p) for layout in layouts if (p := layout.place_in(folder))), None)


def found_below(folder: Path, layouts: Sequence[Layout]) -> tuple[Layout, Place] | None:
    """The only sequence one or two levels below a folder; none if there is none.

    Raises:
        InputError: there are several.
    """
    below = [folder]
    for _ in range(2):
        below = [child for parent in below for child in _folders(parent)][:_MOST_FOLDERS]
        found = [(child, one) for child in below if (one := _whole(child, layouts))]
        if len(found) > 1:
            names = ", ".join(str(child.relative_to(folder)) for child, _ in found[:_NAMED])
            more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
            raise InputError(f"{folder} holds several sequences; give one of {names}{more}.")
        if found:
            return found[0][1]
    return None


def what_is_missing(folder: Path, layouts: Sequence[Layout]) -> str | None:
    """A sentence on the missing part of a folder that resembles a layout; none if none does."""
    for layout in layouts:
        for sign in layout.signs:
            for found in folder.glob(sign):
                return (
                    f"{folder} looks like {layout.name}, for it holds {found.relative_to(folder)}, "
                    f"but {layout.needs} is missing; unpack all of the sequence."
                )
    return None


def _whole(folder: Path, layouts: Sequence[Layout]) -> tuple[Layout, Place] | None:
    """The layout of a folder that is a sequence itself."""
    return found_in(folder, [layout for layout in layouts if layout.holds(folder)])


def _folders(folder: Path) -> Iterator[Path]:
    """Folders in a folder, in order of names; none where access is denied."""
    try:
        yield from sorted(p for p in folder.iterdir() if p.is_dir() and p.name[0] != ".")
    except OSError:
        return
