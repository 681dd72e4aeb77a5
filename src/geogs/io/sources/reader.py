"""Readers of stored images, one for each format; reading ahead or in several threads."""

import hashlib
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from geogs.io.pose_files import FRAMES_PER_SECOND
from geogs.io.sources.account import Account
from geogs.io.sources.calibration import Calibration, same_shape
from geogs.threads import ordered_map
from geogs.types import MeasuredDepth, MeasuredPose, SeenRows

S = TypeVar("S")
T = TypeVar("T")
READERS = 4
"""Number of threads for reads in any order."""


@dataclass(frozen=True, slots=True)
class RawFrame:
    """One image as stored, upright."""

    label: str
    """Its name in messages: the file, or the frame of the video."""
    timestamp: float
    """Seconds."""
    image: UInt8[np.ndarray, "h w 3"] | None
    """RGB; none where it could not be read."""
    is_damaged: bool = False
    """Whether its decoder found a damaged part."""
    why_not: str = "cannot be read"
    """Reason why there is no image, as a clause."""
    change: str = ""
    """Scaling of the image to the size of the others, as a clause."""
    depth: MeasuredDepth | None = None
    """Sensor depth at that time, as stored or at the pixels of a working image."""
    pose: MeasuredPose | None = None
    """Pose of the upright image, by another tracker."""
    name: str = ""
    """Name of its file, or number of the frame, used to find its mask."""
    rows: SeenRows | None = None
    """Rectification of the rows of a working image; none for a global shutter."""
    mask: Bool[np.ndarray, "h w"] | None = None
    """Valid pixels of a working image, by its own mask; none where all are valid."""


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """Metadata of a recording."""

    kind: str
    """Name of the format."""
    name: str
    """Name of the sequence."""
    width: int
    """Width of the upright images, pixels."""
    height: int
    fps: float
    """Frames per second, nominal."""
    length: int | None = None
    """Number of images; none where it is not known before reading to the end."""
    calibration: Calibration | None = None
    """The camera, if the data set describes it."""
    quarter_turns: int = 0
    """Clockwise quarter turns from the stored to the upright images."""
    depths: int = 0
    """Number of images with readable sensor depth."""
    depth_sample: tuple[MeasuredDepth, ...] = ()
    """Some of these depths, as stored."""
    depth_fault: str = ""
    """Reason why listed depth cannot be used, as a clause."""
    has_poses: bool = False
    """Whether poses come with the images that are not ground truth."""
    is_capture: bool = False
    """Whether the poses are a capture app's tracking, in metres."""
    seconds: float | None = None
    """Approximate time of its last image; none where it is not known."""
    first_time: float = 0.0
    """Time of its first image, seconds."""
    account: Account = field(default_factory=Account)
    """Findings of the reader beside the images."""
    pixel_aspect: float = 1.0
    """Width by height of a pixel of the upright images."""

    @property
    def last_time(self) -> float:
        """Approximate time of its last image, seconds."""
        if self.seconds is not None:
            return self.seconds
        return self.first_time + ((self.length or 1) - 1) / self.fps

    @property
    def has_depth(self) -> bool:
        """Whether any image has readable sensor depth."""
        return self.depths > 0


@runtime_checkable
class Reader(Protocol):
    """Reads the images of one format."""

    info: RecordingInfo

    @property
    def paths(self) -> Sequence[Path]:
        """The files that are read."""
        ...

    def read(self, start: int, stop: int | None, stride: int) -> Iterator[RawFrame]:
        """Read images ``start, start + stride, ...`` before ``stop``."""
        ...


@runtime_checkable
class SpreadReader(Protocol):
    """A reader with random access: it skips the images between."""

    def spread(self, starts: Sequence[int]) -> Iterator[RawFrame]:
        """Read an image at each of these indices or, of a video, shortly before it."""
        ...


def of_one_size(raw: RawFrame, info: RecordingInfo) -> RawFrame:
    """The frame; an image of another size is scaled to that of the recording, as streams do that
    adapt to a network, or is none if it has another shape."""
    if raw.image is None:
        return raw
    height, width = raw.image.shape[:2]
    if (width, height) == (info.width, info.height):
        return raw
    if same_shape(width, height, info.width, info.height):
        way = cv2.INTER_AREA if width > info.width else cv2.INTER_LINEAR
        scaled = cv2.resize(raw.image, (info.width, info.height), interpolation=way)
        change = f"is {width}x{height}: scaled to {info.width}x{info.height}"
        return replace(raw, image=scaled, change=change)
    sizes = f"{width}x{height} but the others are {info.width}x{info.height}"
    return replace(raw, image=None, why_not=f"is {sizes}")


def median_rate(steps: Float64[np.ndarray, "n"]) -> float:
    """Median frame rate of time steps in seconds; nominal where no step is above 0."""
    steps = steps[steps > 0]
    return float(1 / np.median(steps)) if len(steps) else FRAMES_PER_SECOND


def read_ahead(items: Iterator[T]) -> Iterator[T]:
    """Yield the items of a generator; a thread makes the next one meanwhile."""
    end = object()
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="read-ahead") as thread:
        pending = thread.submit(next, items, end)
        while (item := pending.result()) is not end:
            pending = thread.submit(next, items, end)
            yield item  # type: ignore[misc]  # not the end mark


def read_side_by_side(read: Callable[[S], T], places: Iterable[S]) -> Iterator[T]:
    """``map(read, places)``; a few threads read the next ones meanwhile."""
    return ordered_map(read, places, READERS, "read-ahead")


def without_ending(name: str, files: Iterable[Path]) -> str:
    """The name of a sequence, without its ending where it is that of one of these files."""
    is_file = any(path.name == name and path.is_file() for path in files)
    return Path(name).stem if is_file else name


def fingerprint_of(paths: Sequence[Path]) -> str:
    """Sixteen digits that depend on the names and sizes of files."""
    sizes = [(p.name, -1 if (size := size_of(p)) is None else size) for p in paths]
    return hashlib.sha256(repr(sizes).encode()).hexdigest()[:16]


def size_of(path: Path) -> int | None:
    """Size of a file in bytes, by one call, as folders may be remote; none if it is missing."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_size if stat.S_ISREG(found.st_mode) else None
