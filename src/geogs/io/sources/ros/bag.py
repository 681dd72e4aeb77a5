"""Bags of ROS 1 (``.bag``) and ROS 2 (a folder, ``.db3``, ``.mcap``), read without ROS."""

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from geogs.errors import GeogsError, InputError
from geogs.extras import install_command
from geogs.guard.documents import (
    LARGEST_DOCUMENT,
    UNUSABLE,
    open_file,
    read_text,
    require_file,
    yaml_value,
)
from geogs.io.sources.account import Account, named
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.reader import RawFrame, RecordingInfo, median_rate
from geogs.io.sources.ros.recorded_messages import (
    CAMERA_INFO,
    COMPRESSED,
    RAW,
    calibration_of,
    picture_of,
    shows,
)
from geogs.io.sources.tones import ASKED, tones_of

_BEGINNINGS = {".bag": b"#ROSBAG V2.0", ".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\0"}
_METADATA = "metadata.yaml"
_SUFFIXES = ("/compressed", "/compressedDepth", "/theora", "/ffmpeg")
"""Suffixes that image transports add to the name of a topic."""
_LOOKED_AT = 30
"""Number of messages used for the rate; the first picture must be among them."""
_OTHER = re.compile(
    "infra|/ir/|thermal|depth|mask|debug|track|feature|detect|overlay|annotat|segment|match"
)
"""Words in topics of other than the camera's own colour or grey images."""
_LEFT = {
    ("colour", "grey"): "images of {}: --topic takes another",
    ("depth",): "depth of {}: that of bags is not read",
    ("",): "images of {}: their encoding is not read",
}
"""Sentences on other topics, by their content."""


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
            chosen, account = _chosen(bag, path, topic)
            self.topic: str = chosen
            """Topic of the images that are read."""
            connections = _connections(bag, chosen)
            times = [t for _, t, _ in islice(bag.messages(connections=connections), _LOOKED_AT)]
            first = next(_pictures(islice(_messages(bag, chosen), _LOOKED_AT)), None)
            if first is None:
                raise InputError(f"{path}: no image on {chosen} can be read; is the bag whole?")
            self._tones = tones_of(_sample(bag, chosen) if first.dtype != np.uint8 else ())
            height, width = first.shape[:2]
            self.info = RecordingInfo(
                "bag",
                path.resolve().name,
                width,
                height,
                fps=median_rate(np.diff(np.array(times, dtype=np.float64)) * 1e-9),
                length=sum(c.msgcount for c in connections),
                calibration=_calibration(bag, chosen),
                account=account + self._tones.account,
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
                last = time
                found = picture_of(message)
                image = None if found.picture is None else self._tones(found.picture)
                yield RawFrame(label, time, image, found.is_damaged)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a bag, and close it at the end. Raises InputError for errors of its reader."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        from geogs.io.sources.ros.database import Recording
        from geogs.io.sources.ros.decompression import TooLarge, bound_decompression
    except ImportError as error:
        raise InputError(
            f"{path} is a recording of ROS, which needs rosbags: {install_command('ros')}"
        ) from error
    _require_files(path)
    bound_decompression()
    try:
        # The image types are the same in all of ROS 2, whose older bags do not describe them.
        bag = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        if bag.is2:
            bag.readers = [Recording(path)]
        bag.open()
    except TooLarge as error:
        raise InputError(f"{path}: {error}; leave it out.") from None
    except Exception as error:  # errors of its own, of SQLite, of YAML, of a damaged file
        raise InputError(
            f"{path} cannot be opened as a recording of ROS; is it complete and closed?"
        ) from error
    try:
        yield bag
    except (GeogsError, MemoryError):
        raise
    except TooLarge as error:
        raise InputError(f"{path}: {error}; leave it out.") from None
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


def _chosen(bag: Any, path: Path, asked: str) -> tuple[str, Account]:
    """The topic to read, the given one or the likeliest, and what is said of all.

    Raises:
        InputError: there are no images, or none on the given topic.
    """
    topics = {t: info.msgcount for t, info in bag.topics.items() if _has_images(bag, t)}
    listed = ", ".join(sorted(topics)) or "none"
    if asked != "auto" and asked not in topics:
        raise InputError(f"{path} has no images on that topic; it has: {listed}.")
    kinds = {topic: _shown(bag, topic) for topic in sorted(topics)}

    def likelihood(topic: str) -> tuple[bool, bool, bool, bool, int]:
        """Colour before infrared and grey, with camera info before without, raw before compressed;
        of equal ones the first by name, the left of two."""
        base = _without_transport(topic)
        return (
            not _OTHER.search(base.lower()),
            kinds[topic] == "colour",
            _camera_topic(bag, topic) is not None,
            base == topic,
            topics[topic],
        )

    likely = [topic for topic, kind in kinds.items() if kind in ("colour", "grey")]
    chosen = max(likely, key=likelihood, default="") if asked == "auto" else asked
    if not chosen:
        raise InputError(f"{path} holds no topic with images; topics with some: {listed}.")
    if kinds[chosen] == "depth":
        raise InputError(f"{path}: {asked} shows depth, not images; there are: {listed}.")
    left = []
    for shown, sentence in _LEFT.items():
        others = [topic for topic in kinds if kinds[topic] in shown and topic != chosen]
        left += [sentence.format(named(others))] if others else []
    return chosen, Account((f"images: topic {chosen}",), tuple(left))


def _has_images(bag: Any, topic: str) -> bool:
    return any(c.msgtype in (RAW, COMPRESSED) and c.msgcount for c in _connections(bag, topic))


def _messages(bag: Any, topic: str, start: int | None = None) -> Iterator[Any]:
    """The messages of a topic from a time on; none for a damaged one."""
    for connection, _, data in bag.messages(connections=_connections(bag, topic), start=start):
        yield _read(bag, connection, data)


def _pictures(messages: Iterable[Any]) -> Iterator[np.ndarray]:
    """The pictures of those messages that hold one."""
    found = (picture_of(message).picture for message in messages if message is not None)
    return (picture for picture in found if picture is not None)


def _shown(bag: Any, topic: str) -> str:
    """Content of the first whole message of a topic, see :func:`shows`."""
    first = islice(_messages(bag, topic), _LOOKED_AT)
    return next((shows(message, topic) for message in first if message is not None), "")


def _sample(bag: Any, topic: str) -> Iterator[np.ndarray]:
    """Some pictures spread over the bag."""
    for time in np.linspace(bag.start_time, bag.end_time, ASKED, endpoint=False).astype(int):
        yield from _pictures(islice(_messages(bag, topic, int(time)), 1))


def _calibration(bag: Any, topic: str) -> Calibration | None:
    source = _camera_topic(bag, topic)
    if source is None or (message := next(_messages(bag, source), None)) is None:
        return None
    is_rectified = _without_transport(topic).rsplit("/", 1)[-1].startswith("image_rect")
    return calibration_of(message, source, is_rectified)


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
