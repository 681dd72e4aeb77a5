"""Open whatever image set with poses the user points at."""

from collections.abc import Callable
from pathlib import Path

from geogs.config import InputConfig
from geogs.documents import expanded
from geogs.errors import InputError
from geogs.io.sources.posed.base import PosedSource
from geogs.io.sources.posed.colmap import find_model, open_colmap
from geogs.io.sources.posed.dtu import is_dtu, open_dtu
from geogs.io.sources.posed.files import PosedSet
from geogs.io.sources.posed.nerfstudio import find_transforms, open_nerfstudio
from geogs.io.sources.posed.replica import is_posed_replica, open_posed_replica
from geogs.io.sources.posed.scannet import is_scannet, open_scannet
from geogs.io.sources.posed.seven_scenes import is_posed_seven_scenes, open_posed_seven_scenes
from geogs.io.sources.posed.tum import is_posed_tum, open_posed_tum

# Earlier ones win: data sets with an own description often carry a COLMAP model besides.
_FORMATS: tuple[tuple[Callable[[Path], object], Callable[[Path], PosedSet]], ...] = (
    (is_dtu, open_dtu),
    (find_transforms, open_nerfstudio),
    (find_model, open_colmap),
    (is_posed_tum, open_posed_tum),
    (is_posed_seven_scenes, open_posed_seven_scenes),
    (is_posed_replica, open_posed_replica),
    (is_scannet, open_scannet),
)


def open_posed_source(
    path: str | Path, config: InputConfig | None = None, hold_out: int | None = None
) -> PosedSource:
    """Open an image set together with its known poses.

    The format follows from the content: a COLMAP model, nerfstudio's ``transforms.json``, DTU's
    ``cameras.npz``, Replica, TUM RGB-D, 7-Scenes, ScanNet or ScanNet++.

    Args:
        path: the folder, or the file with the poses.
        config: selection of images, intrinsics and working resolution; the defaults if none.
        hold_out: every so many-th of the selected images is left out; none leaves out none.

    Raises:
        InputError: no images with poses are there, or they cannot be used.
    """
    path = expanded(path)
    try:
        return PosedSource(_posed_set(path), config or InputConfig(), hold_out)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error


def holds_posed_images(path: Path) -> bool:
    """Whether a folder is laid out as a set of images with known poses, usable or not."""
    return path.is_dir() and any(is_format(path) for is_format, _ in _FORMATS)


def _posed_set(path: Path) -> PosedSet:
    if not path.exists():
        raise InputError(f"{path} does not exist; give a folder of images with poses.")
    if path.is_file():
        if find_transforms(path):
            return open_nerfstudio(path)
        path = path.parent if path.suffix in (".npz", ".bin", ".txt") else path
    for is_format, open_format in _FORMATS:
        if path.is_dir() and is_format(path):
            return open_format(path)
    raise InputError(
        f"{path} holds no images with known poses (COLMAP model, nerfstudio transforms.json, DTU "
        f"cameras.npz, Replica, TUM RGB-D, 7-Scenes or ScanNet); use --poses auto for photographs, "
        "geogs run for a video."
    )
