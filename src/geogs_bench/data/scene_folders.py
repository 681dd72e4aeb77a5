"""Search for scenes in the user's folder: itself, or folders below it."""

from collections.abc import Callable
from pathlib import Path

from geogs.io.sources.formats.image_files import natural_key


def folders_like(
    root: Path, is_scene: Callable[[Path], bool], below: tuple[str, ...] = ()
) -> list[Path]:
    """``root`` if it is a scene, else the scenes directly in it or in its folders ``below``.

    They are in natural order of their names, so scan40 comes before scan105.
    """
    if is_scene(root):
        return [root]
    places = [root, *(root / name for name in below)]
    found = [
        folder
        for place in places
        if place.is_dir()
        for folder in place.iterdir()
        if folder.is_dir() and not folder.name.startswith(".") and is_scene(folder)
    ]
    return sorted(found, key=lambda folder: natural_key(folder.name))


def first_file(*candidates: Path) -> Path | None:
    """The first file that exists, or none; a name may be a pattern such as ``mesh_*.ply``."""
    for candidate in candidates:
        matches = sorted(candidate.parent.glob(candidate.name))
        if matches:
            return matches[0]
    return None
