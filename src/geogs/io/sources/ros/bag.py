"""Bags of ROS 1 (``.bag``) and ROS 2 (a folder, ``.db3``, ``.mcap``), read without ROS."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from geogs.documents import (
    LARGEST_DOCUMENT,
    UNUSABLE,
    open_file,
    read_text,
    require_file,
    yaml_value,
)
from geogs.errors import GeogsError, InputError
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.reader import RawFrame, RecordingInfo, median_rate
from geogs.io.sources.ros.recorded_messages import (
    CAMERA_INFO,
    COMPRESSED,
    RAW,
    calibration_of,
    is_picture,
    picture_of,
)

_log = logging.getLogger(__name__)

_BEGINNINGS = {".bag": b"#ROSBAG V2.0", ".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\0"}
_METADATA = "metadata.yaml"
_SUFFIXES = ("/compressed", "/compressedDepth", "/theora", "/ffmpeg")
"""Suffixes that image transports add to the name of a topic."""
_LOOKED_AT = 30
"""Number of messages used for the rate; the first picture must be among them."""


def is_bag(path: Path) -> bool:
    """Whether ``path`` is a recording of ROS: by its ending and its first bytes."""
    if path.is_dir():
        metadata = path / _METADATA
        return metadata.is_file() and b"rosbag2_bagfile_information" in _head(metadata)
    beginning = _BEGINNINGS.get(path.suffix.lower())
    return beginning is not None and _head(path).startswith(beginning)


class Bag:
    """Reader of the images of one topic."""

    def __init__(self, path: Path, topic: str = "auto") -> None:
        """``topic`` is that of the images, or ``auto`` for the most likely camera.

        Raises:
            InputError: ``rosbags`` is not installed, the bag is damaged, or has no such images.
        """
        self._path = path
        with _opened(path) as bag:
            chosen = _chosen(bag, path, topic)
            self.topic: str = chosen
            """Topic of the images that are read."""
            connections = _connections(bag, chosen)
            length = sum(c.msgcount for c in connections)
            times = [t for _, t, _ in islice(bag.messages(connections=connections), _LOOKED_AT)]
            fps = median_rate(np.diff(np.array(times, dtype=np.float64)) * 1e-9)
            first = _first_picture(bag, connections)
            if first is None:
                raise InputError(f"{path}: no image on {chosen} can be read; is the bag whole?")
            (height, width), calibration = first.shape[:2], _calibration(bag, chosen)
            self.info = RecordingInfo(
                "bag", path.resolve().name, width, height, fps, length, calibration
            )

    @property
    def paths(self) -> list[Path]:
        """The files that are read, without the metadata of a ROS 2 bag."""
        if not self._path.is_dir():
            return [self._path]
        files = (path for path in self._path.iterdir() if path.is_file())
        return sorted(path for path in files if path.name != _METADATA)

    def read(self, start: int, stop: int | None, stride: int) -> Iterator[RawFrame]:
        """Go through the topic from its beginning and decode ``start, start + stride, ...``.

        Times are those of the headers; where they do not increase, an image cannot be used.
        """
        last = -np.inf
        with _opened(self._path) as bag:
            messages = bag.messages(connections=_connections(bag, self.topic))
            chosen = islice(enumerate(messages), start, stop, stride)
            for index, (connection, received, data) in chosen:
                label = f"{self.info.name}, image {index}"
                message = _read(bag, connection, data)
                if message is None:
                    yield RawFrame(label, max(last, 0.0), None)
                    continue
                time = _stamp(message) or received * 1e-9
                if time <= last:
                    late = "is stamped no later than the one before"
                    yield RawFrame(label, time, None, why_not=late)
                    continue
                last, found = time, picture_of(message)
                yield RawFrame(label, time, found.picture, found.is_damaged)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a bag, and close it at the end. Raises InputError for errors of its reader."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(
            f"{path} is a recording of ROS; pip install 'geogs[ros]' brings what reads it."
        ) from error
    _require_files(path)
    try:
        # The image types are the same in all of ROS 2, whose older bags do not describe them.
        bag = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        bag.open()
    except Exception as error:  # errors of its own, of SQLite, of YAML, of a damaged file
        raise InputError(
            f"{path} cannot be opened as a recording of ROS; is it complete and closed?"
        ) from error
    try:
        yield bag
    except (GeogsError, MemoryError):
        raise
    except Exception as error:  # a damaged index may fail later, too
        raise InputError(f"{path} is damaged as a recording of ROS; copy it again.") from error
    finally:
        with suppress(Exception):  # closing may fail, too
            bag.close()


def _require_files(path: Path) -> None:
    """Raise InputError where the reader would open anything but plain files of the recording."""
    if not path.is_dir():
        require_file(path)
        return
    metadata = path / _METADATA
    try:
        said = yaml_value(read_text(metadata, LARGEST_DOCUMENT), str(metadata))
        names = [str(name) for name in said["rosbag2_bagfile_information"]["relative_file_paths"]]
    except UNUSABLE:
        raise InputError(f"{metadata} is damaged as that of a recording of ROS.") from None
    for name in names:
        if Path(name).name != name:
            raise InputError(f"{metadata} names files of other folders; copy them beside it.")
        require_file(path / name)


def _chosen(bag: Any, path: Path, asked: str) -> str:
    """The topic to read: the given one, or the likeliest. Raises InputError without any."""
    topics = {t: info.msgcount for t, info in bag.topics.items() if _has_images(bag, t)}
    listed = ", ".join(sorted(topics)) or "none"
    if asked != "auto":
        if asked not in topics:
            raise InputError(f"{path} has no images on the topic asked for; there are: {listed}.")
        return asked
    likely = [t for t in sorted(topics) if _first_is_picture(bag, t)]
    if not likely:
        raise InputError(f"{path} holds no topic with images; topics with some: {listed}.")
    chosen = max(likely, key=lambda t: (_likelihood(bag, t), topics[t]))
    if len(likely) > 1:
        _log.info("Reading %s; --topic takes another of %s.", chosen, ", ".join(likely))
    return chosen


def _likelihood(bag: Any, topic: str) -> tuple[bool, bool, bool]:
    """Sort key: colour before infrared, with camera info before without, raw before compressed; of
    equal ones the first by name, the left of two."""
    base = _without_transport(topic).lower()
    is_other = any(word in base for word in ("infra", "/ir/", "thermal", "depth", "mask", "debug"))
    return not is_other, _camera_topic(bag, topic) is not None, base == topic.lower()


def _has_images(bag: Any, topic: str) -> bool:
    return any(c.msgtype in (RAW, COMPRESSED) and c.msgcount for c in _connections(bag, topic))


def _first_is_picture(bag: Any, topic: str) -> bool:
    connections = _connections(bag, topic)
    some = islice(bag.messages(connections=connections), 1)
    messages = [_read(bag, connection, data) for connection, _, data in some]
    return any(m is not None and is_picture(m) for m in messages)


def _first_picture(bag: Any, connections: Sequence[Any]) -> np.ndarray | None:
    for connection, _, data in islice(bag.messages(connections=connections), _LOOKED_AT):
        message = _read(bag, connection, data)
        if message is not None and (found := picture_of(message).picture) is not None:
            return found
    return None


def _calibration(bag: Any, topic: str) -> Calibration | None:
    source = _camera_topic(bag, topic)
    if source is None:
        return None
    is_rectified = _without_transport(topic).rsplit("/", 1)[-1].startswith("image_rect")
    for connection, _, data in islice(bag.messages(connections=_connections(bag, source)), 1):
        message = _read(bag, connection, data)
        if message is not None:
            return calibration_of(message, source, is_rectified)
    return None


def _camera_topic(bag: Any, topic: str) -> str | None:
    """Topic with the camera of an image topic: beside it, or the only one in the bag."""
    known = [c.topic for c in bag.connections if c.msgtype == CAMERA_INFO and c.msgcount]
    base = _without_transport(topic)
    beside = (f"{base.rpartition('/')[0]}/camera_info", f"{base}/camera_info")
    images = [c.topic for c in bag.connections if c.msgtype in (RAW, COMPRESSED)]
    is_alone = len(set(known)) == 1 and len(set(map(_without_transport, images))) == 1
    alone = known if is_alone else []
    return next((name for name in (*beside, *alone) if name in known), None)


def _without_transport(topic: str) -> str:
    suffix = next((s for s in _SUFFIXES if topic.endswith(s)), "")
    return topic.removesuffix(suffix)


def _connections(bag: Any, topic: str) -> list[Any]:
    return [c for c in bag.connections if c.topic == topic]


def _read(bag: Any, connection: Any, data: bytes) -> Any:
    """The message; none where it is damaged."""
    try:
        return bag.deserialize(data, connection.msgtype)
    except Exception:  # wrong lengths may raise any exception
        return None


def _stamp(message: Any) -> float:
    """Time of the header in seconds; 0 where it is not set."""
    stamp = message.header.stamp
    return float(stamp.sec) + float(stamp.nanosec) * 1e-9


def _head(path: Path) -> bytes:
    try:
        with open_file(path) as stream:
            return stream.read(4096)
    except InputError:
        return b""
