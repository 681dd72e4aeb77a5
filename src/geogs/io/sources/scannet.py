"""ScanNet as exported: ``color/0.jpg, ...`` with ``depth/0.png`` and ``intrinsic/``."""

from pathlib import Path

from geogs.io.poses import FRAMES_PER_SECOND
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.calibration_files import read_calibration
from geogs.io.sources.depth_files import DepthFile
from geogs.io.sources.images import SUFFIXES, ImageFile, ImageList

_PER_METRE = 1000.0


def is_scannet(folder: Path) -> bool:
    """Whether ``folder`` is a scene."""
    colour, depth = folder / "color", folder / "depth"
    return colour.is_dir() and depth.is_dir() and bool(numbered_images(folder))


def open_scannet(folder: Path) -> ImageList:
    """Read a scene; image k is at k / 30 s. Depth has been registered to colour."""
    depths = {int(p.stem): p for p in (folder / "depth").glob("*.png") if p.stem.isdecimal()}
    files = [
        ImageFile(
            path,
            k / FRAMES_PER_SECOND,
            DepthFile(depths[k], _PER_METRE) if k in depths else None,
        )
        for k, path in numbered_images(folder)
    ]
    return ImageList("scannet", folder.resolve().name, files, scannet_calibration(folder))


def scannet_calibration(folder: Path) -> Calibration | None:
    """The colour camera of a scene, if it is told."""
    intrinsic = folder / "intrinsic" / "intrinsic_color.txt"
    return read_calibration(intrinsic) if intrinsic.is_file() else None


def numbered_images(folder: Path) -> list[tuple[int, Path]]:
    """The images of a scene by their numbers, padded with zeros or not."""
    return sorted(
        (int(path.stem), path)
        for path in (folder / "color").iterdir()
        if path.stem.isdecimal() and path.suffix.lower() in SUFFIXES
    )
