"""Open whatever image set with poses the user points at."""

from pathlib import Path

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.posed.base import PosedSource
from geogs.io.sources.posed.files import PosedSet
from geogs.io.sources.posed.replica import is_posed_replica, open_posed_replica


def open_posed_source(path: str | Path, config: InputConfig | None = None) -> PosedSource:
    """Open an image set together with its known poses.

    The format follows from the content: a COLMAP model, nerfstudio's ``transforms.json``, DTU's
    ``cameras.npz``, Replica, TUM RGB-D, 7-Scenes, ScanNet or ScanNet++.

    Args:
        path: the folder, or the file with the poses.
        config: selection of images, intrinsics and working resolution; the defaults if none.

    Raises:
        InputError: no images with poses are there, or they cannot be used.
    """
    path = Path(path).expanduser()
    try:
        return PosedSource(_posed_set(path), config or InputConfig())
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error


def _posed_set(path: Path) -> PosedSet:
    if not path.exists():
        raise InputError(f"{path} does not exist; give a folder of images with poses.")
    if path.is_dir() and is_posed_replica(path):
        return open_posed_replica(path)
    raise InputError(
        f"{path} holds no images with known poses (COLMAP model, nerfstudio transforms.json, DTU "
        f"cameras.npz, Replica, TUM RGB-D, 7-Scenes or ScanNet); use geogs run for images alone."
    )
