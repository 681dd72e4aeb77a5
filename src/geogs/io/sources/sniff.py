"""Open whatever the user points at."""

from collections.abc import Callable, Sequence
from pathlib import Path

from geogs.config import InputConfig
from geogs.documents import expanded
from geogs.errors import InputError
from geogs.io.sources.address import LiveAddress, live_address
from geogs.io.sources.formats import (
    colmap,
    dtu,
    nerfstudio,
    polycam,
    record3d,
    replica,
    scannet,
    seven_scenes,
    tum,
)
from geogs.io.sources.formats.image_files import SUFFIXES, open_image_folder
from geogs.io.sources.frame_source import Source
from geogs.io.sources.posed.posed_set import PosedSet
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.sources.reader import Reader
from geogs.io.sources.ros.bag import Bag, is_bag
from geogs.io.sources.working_images import WorkingImages

# Earlier ones win.
_FORMATS: tuple[tuple[Callable[[Path], object], Callable[[Path], Reader]], ...] = (
    (tum.is_tum, tum.open_tum),
    (seven_scenes.is_seven_scenes, seven_scenes.open_seven_scenes),
    (replica.is_replica, replica.open_replica),
    (scannet.is_scannet, scannet.open_scannet),
)
# Data sets with an own description often carry a COLMAP model besides.
_POSED_FORMATS: tuple[tuple[Callable[[Path], object], Callable[[Path], PosedSet]], ...] = (
    (dtu.is_dtu, dtu.open_dtu),
    (nerfstudio.find_transforms, nerfstudio.open_nerfstudio),
    (colmap.find_model, colmap.open_colmap),
    (tum.is_posed_tum, tum.open_posed_tum),
    (seven_scenes.is_posed_seven_scenes, seven_scenes.open_posed_seven_scenes),
    (replica.is_posed_replica, replica.open_posed_replica),
    (scannet.is_posed_scannet, scannet.open_posed_scannet),
)


def open_source(
    path: str | Path | Sequence[str | Path], config: InputConfig | None = None
) -> Source:
    """Open a video, a folder of images, a bag of ROS, or a Replica, TUM RGB-D or 7-Scenes sequence.

    The format follows from the content. Ground truth that lies beside the images is not read.
    ``camera:0``, an URL such as ``rtsp://…``, ``-`` (raw frames from standard input) and
    ``play:FILE`` (a file at its pace) do not wait: of their frames the newest is given each time.

    Args:
        path: the file or folder; several of one place, by one camera, become one stream.
        config: selection of frames, intrinsics and working resolution; the defaults if none.

    Raises:
        InputError: nothing usable is there, ``config`` does not fit it, or the cameras differ.
    """
    paths = [path] if isinstance(path, str | Path) else path
    config = config or InputConfig()
    if not paths:
        raise InputError("Nothing to read; give a video or a folder of images.")
    addresses = [live_address(one) for one in paths]
    if len(paths) > 1 and any(addresses):
        raise InputError(
            "A camera, a stream or a pipe is read alone; give no other source with it."
        )
    readers = (
        _reader(expanded(one), config) if address is None else _live_reader(address, config)
        for one, address in zip(paths, addresses, strict=True)
    )
    return Source([WorkingImages(reader, config) for reader in readers])


def _live_reader(address: LiveAddress, config: InputConfig) -> Reader:
    from geogs.io.sources.live.feeds import open_live  # loads OpenCV

    is_played = address.kind == "play"
    played = _reader(expanded(address.target), config) if is_played else None
    return open_live(address, config.pipe, played)


def _reader(path: Path, config: InputConfig) -> Reader:
    topic = config.topic
    try:
        if path.exists() and is_bag(path):
            return Bag(path, topic)
        if topic != "auto":
            raise InputError(f"{path} is no bag of ROS, which alone has topics; leave out --topic.")
        if path.exists() and record3d.is_record3d(path):
            return record3d.Record3dRecording(path)
        if path.is_dir():
            return _folder_reader(path, config.poses.strip().lower() == "prior")
        if not path.exists():
            raise InputError(f"{path} does not exist; give a video or a folder of images.")
        if path.suffix.lower() in SUFFIXES:
            raise InputError(f"{path} is a single picture; give a video or a folder of images.")
        if path.stat().st_size == 0:
            raise InputError(f"{path} is empty; is the copy or download complete?")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    from geogs.io.sources.formats.video_file import VideoFile  # loads FFmpeg

    return VideoFile(path)


def _folder_reader(folder: Path, wants_poses: bool) -> Reader:
    for is_format, open_format in _FORMATS:
        if is_format(folder):
            return open_format(folder)
    if (folder / "rgb.mp4").is_file():
        from geogs.io.sources.formats.stray import StrayRecording, is_stray  # loads FFmpeg

        if is_stray(folder):
            return StrayRecording(folder)
    if polycam.polycam_folders(folder) is not None:
        return polycam.open_polycam(folder)
    images = open_image_folder(folder)
    return nerfstudio.with_transforms(images, folder) if wants_poses else images


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
    return path.is_dir() and any(is_format(path) for is_format, _ in _POSED_FORMATS)


def _posed_set(path: Path) -> PosedSet:
    if not path.exists():
        raise InputError(f"{path} does not exist; give a folder of images with poses.")
    if path.is_file():
        if nerfstudio.find_transforms(path):
            return nerfstudio.open_nerfstudio(path)
        path = path.parent if path.suffix in (".npz", ".bin", ".txt") else path
    for is_format, open_format in _POSED_FORMATS:
        if path.is_dir() and is_format(path):
            return open_format(path)
    raise InputError(
        f"{path} holds no images with known poses (COLMAP model, nerfstudio transforms.json, DTU "
        f"cameras.npz, Replica, TUM RGB-D, 7-Scenes or ScanNet); use --poses auto for photographs, "
        "geogs run for a video."
    )
