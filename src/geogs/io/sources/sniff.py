"""Open whatever the user points at."""

from collections.abc import Sequence
from pathlib import Path
from typing import overload

from geogs.config import InputConfig
from geogs.documents import expanded
from geogs.errors import InputError
from geogs.io.sources.address import LiveAddress, live_address
from geogs.io.sources.base import Reader, Source
from geogs.io.sources.captures import open_polycam, polycam_folders, with_transforms
from geogs.io.sources.images import SUFFIXES, open_image_folder
from geogs.io.sources.record3d import Record3dRecording, is_record3d
from geogs.io.sources.replica import is_replica, open_replica
from geogs.io.sources.ros.bag import Bag, is_bag
from geogs.io.sources.scannet import is_scannet, open_scannet
from geogs.io.sources.seven_scenes import is_seven_scenes, open_seven_scenes
from geogs.io.sources.several import SeveralSources
from geogs.io.sources.tum import is_tum, open_tum

Stream = Source | SeveralSources
"""What a run reads."""


@overload
def open_source(path: str | Path, config: InputConfig | None = None) -> Source: ...
@overload
def open_source(path: Sequence[str | Path], config: InputConfig | None = None) -> Stream: ...
def open_source(
    path: str | Path | Sequence[str | Path], config: InputConfig | None = None
) -> Stream:
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
    if isinstance(path, str | Path):
        config = config or InputConfig()
        address = live_address(path)
        if address is not None:
            return Source(_live_reader(address, config), config)
        return Source(_reader(expanded(path), config), config)
    if not path:
        raise InputError("Nothing to read; give a video or a folder of images.")
    if len(path) > 1 and any(live_address(one) is not None for one in path):
        raise InputError(
            "A camera, a stream or a pipe is read alone; give no other source with it."
        )
    sources = [open_source(one, config) for one in path]
    return sources[0] if len(sources) == 1 else SeveralSources(sources)


def _live_reader(address: LiveAddress, config: InputConfig) -> Reader:
    from geogs.io.sources.live.open import open_live  # loads OpenCV

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
        if path.exists() and is_record3d(path):
            return Record3dRecording(path)
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
    from geogs.io.sources.video import VideoFile  # loads FFmpeg

    return VideoFile(path)


def _folder_reader(folder: Path, wants_poses: bool) -> Reader:
    if is_tum(folder):
        return open_tum(folder)
    if is_seven_scenes(folder):
        return open_seven_scenes(folder)
    if is_replica(folder):
        return open_replica(folder)
    if is_scannet(folder):
        return open_scannet(folder)
    if (folder / "rgb.mp4").is_file():
        from geogs.io.sources.stray import StrayRecording, is_stray  # loads FFmpeg

        if is_stray(folder):
            return StrayRecording(folder)
    if polycam_folders(folder) is not None:
        return open_polycam(folder)
    images = open_image_folder(folder)
    return with_transforms(images, folder) if wants_poses else images
