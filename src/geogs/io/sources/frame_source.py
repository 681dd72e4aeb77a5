"""A source: one or several recordings of a scene, read as a single stream of frames."""

import copy
import logging
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, UInt8

from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.camera.shutter.shutter import Shutter
from geogs.errors import InputError
from geogs.io.sources.account import Account
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.live.live_reader import LiveReader
from geogs.io.sources.reader import RawFrame, fingerprint_of, without_ending
from geogs.io.sources.working_images import WorkingImages
from geogs.types import FoundLens, Frame

_log = logging.getLogger(__name__)
PAUSE = 1.0
"""Seconds between the last frame of a recording and the first of the next, in the joint time."""
SAME = 0.01
"""Relative difference up to which two focal lengths count as one."""


@dataclass(frozen=True, slots=True)
class RecordingSpan:
    """One recording within the joint stream."""

    name: str
    first_frame: int
    first_time: float
    """Seconds, in the joint time."""
    own_time: float
    """Time of its first frame in its own clock."""

    @property
    def shift(self) -> float:
        """Seconds from its own clock to the joint time."""
        return self.first_time - self.own_time


@dataclass(frozen=True, slots=True)
class RecordingPlace:
    """Progress of reading one recording."""

    span: RecordingSpan | None = None
    """None before its first frame."""
    shift: float = 0.0
    """Seconds from its own clock to the joint time."""
    frames: int = 0
    """Number of frames yielded."""
    skipped: int = 0
    """Number of images so far that could not be read, or are of another size."""
    damaged: int = 0
    """Number of frames of which a part is damaged."""
    scaled: int = 0
    """Number of frames that were scaled to the size of the others."""

    @property
    def read(self) -> int:
        """Number of images read so far."""
        return self.frames + self.skipped

    def after(self, raw: RawFrame) -> "RecordingPlace":
        """Progress after one more image; the first skipped, scaled or damaged one is logged."""
        if raw.image is None:
            if not self.skipped:
                _log.warning("%s %s; skipped.", raw.label, raw.why_not)
            return replace(self, skipped=self.skipped + 1)
        if raw.is_damaged and not self.damaged:
            _log.warning("%s is damaged; used as far as it goes.", raw.label)
        if raw.change and not self.scaled:
            _log.warning("%s %s, as are others like it.", raw.label, raw.change)
        return replace(
            self,
            frames=self.frames + 1,
            damaged=self.damaged + raw.is_damaged,
            scaled=self.scaled + bool(raw.change),
        )


@dataclass(frozen=True, slots=True)
class ReadingPlace:
    """Progress of reading a source."""

    frames: int = 0
    """Number of frames yielded, of all recordings together."""
    time: float = 0.0
    """Joint time of the last frame, in seconds."""
    recordings: tuple[RecordingPlace, ...] = ()
    """Progress in each started recording."""

    @property
    def skipped(self) -> int:
        """Images that could not be read or are of another size."""
        return sum(place.skipped for place in self.recordings)

    @property
    def damaged(self) -> int:
        """Images of which a part is damaged."""
        return sum(place.damaged for place in self.recordings)


class Source:
    """Frames of the recordings one after the other, numbered and timed through.

    They are at working resolution, with their lens, in time order, all of one camera, and can be
    iterated over repeatedly. No motion links the first frame of a recording to the last of the one
    before.
    """

    def __init__(self, recordings: Sequence[WorkingImages]) -> None:
        """At least one recording. Raises InputError if their cameras differ."""
        first, *others = recordings
        for other in others:
            _check_same(first, other)
        self._recordings = tuple(recordings)
        self.name = " + ".join(images.name for images in recordings)
        """Names of the sequences."""
        stems = (without_ending(images.name, images.reader.paths) for images in recordings)
        self.stem = " + ".join(stems)
        """The same without the endings of files, for a folder of results."""
        self.kind = first.reader.info.kind
        """The format of the first: video, images, bag, replica, tum or 7scenes."""
        self.camera = first.camera
        """The pinhole of straight frames, of the frames' size."""
        self.image_camera = first.image_camera
        """The camera of every frame, with its lens unless they are :meth:`straight`."""
        self.calibration = first.calibration
        """The camera of the first recording's images as stored, upright, with its distortion."""
        self.shutter = first.shutter
        """The shutter by which rows are rectified."""
        self.mask = first.mask
        """Valid pixels of every frame; none where all are valid."""
        self.fps = first.fps
        """Frames per second after the stride, nominal."""
        self.recorded_fps = first.reader.info.fps
        """Images per second before the stride."""
        lengths = [images.length for images in recordings]
        self.length = None if None in lengths else sum(n for n in lengths if n is not None)
        """Expected number of frames, unreadable ones included; none where not known beforehand."""
        self.black_is_masked = first.black_is_masked
        """Whether black pixels of frames are masked out."""
        self.uses_depth = any(images.depth.is_used for images in recordings)
        """Whether frames of any recording have sensor depth."""
        self.account = sum((images.account for images in recordings), Account())
        """Findings beside the images: those used, and those not used with the reason."""
        self.uses_poses = any(images.poses.is_used for images in recordings)
        """Whether frames of any recording have pose priors of another tracker."""
        self.is_live = first.is_live
        """Whether the source is live; such a recording is read alone."""
        self.is_calibration_open = any(images.is_calibration_open for images in recordings)
        """Whether the focal length is a guess or nominal, not given by user or data set."""
        self.is_overlay_open = first.is_overlay_open
        """Whether no mask was given, and static overlays may be masked out."""
        self.takes = first.takes
        """Part of the images that is used: auto, none, or what ``--take`` names."""
        self.is_shutter_open = first.is_shutter_open
        """Whether the readout is not known yet, and can be estimated from the frames."""
        self.place = ReadingPlace()
        """Progress of reading, at each frame of this iteration."""

    def __len__(self) -> int:
        """Return ``length``. Raises TypeError where it is not known."""
        if self.length is None:
            raise TypeError(f"It is not known beforehand how many frames {self.name} has.")
        return self.length

    def __bool__(self) -> bool:
        """True, however many frames there are."""
        return True

    def __repr__(self) -> str:
        frames = "?" if self.length is None else self.length
        size = f"{self.camera.width}×{self.camera.height}"
        return f"Source({self.name!r}: {self.kind}, {frames} frames of {size})"

    @property
    def found(self) -> str:
        """The images as stored, in words."""
        sizes = (images.reader.info for images in self._recordings)
        size = ", ".join(dict.fromkeys(f"{info.width}x{info.height}" for info in sizes))
        count = "images" if self.length is None else f"{self.length} images"
        return f"{self.name}, {count} of {size} ({self.kind})"

    @property
    def dropped(self) -> int:
        """Frames of a live source that came too fast to be used, so far in this iteration."""
        reader = self._recordings[0].reader
        return reader.dropped if isinstance(reader, LiveReader) else 0

    @property
    def spans(self) -> list[RecordingSpan]:
        """Beginnings of several recordings, as far as they were read; none for a single one."""
        if len(self._recordings) == 1:
            return []
        return [place.span for place in self.place.recordings if place.span is not None]

    @property
    def intrinsics_origin(self) -> str:
        """Origin of the intrinsics."""
        return self.calibration.origin

    def with_calibration(self, calibration: Calibration) -> "Source":
        """The same frames by another calibration of the stored images."""
        return Source([images.known_better(calibration) for images in self._recordings])

    def with_lens(self, found: FoundLens) -> "Source":
        """The same frames, unchanged, with a better calibration of the stored images."""
        same = copy.copy(self)
        same.calibration = self.calibration.with_lens(found)
        return same

    def with_shutter(self, shutter: Shutter) -> "Source":
        """The same frames, with their rows rectified by another readout."""
        return Source([images.known_better(shutter=shutter) for images in self._recordings])

    def straight(self) -> "Source":
        """The same frames, undistorted."""
        return Source([images.known_better(keeps_lens=False) for images in self._recordings])

    def with_focal(self, focal: float) -> "Source":
        """The same frames, rendered for a pinhole of that focal length."""
        return Source([images.known_better(focal=focal) for images in self._recordings])

    def without_overlay(self, overlay: Bool[np.ndarray, "h w"]) -> "Source":
        """The same frames, with a static overlay of the images of :meth:`spread` masked out."""
        return Source([images.known_better(overlay=overlay) for images in self._recordings])

    def spread(self, count: int) -> list[UInt8[np.ndarray, "h w 3"]]:
        """Read ``count`` images spread over the recordings, at working size, lens and rows as
        stored; none of a live source."""
        each = -(-count // len(self._recordings))
        found = [raw.image for images in self._recordings for raw in images.spread(each)]
        return [image for image in found if image is not None]

    @property
    def rolling_camera(self) -> RollingCamera:
        """The camera of the first recording's images at working size, lens and rows as stored."""
        return self._recordings[0].rolling_camera

    def as_recorded(self) -> Generator[Frame, None, None]:
        """All frames of the first recording, at stride 1, straight, without row rectification."""
        return iter(Source([self._recordings[0].as_recorded()]))

    def fingerprint(self) -> str:
        """Sixteen digits per recording that depend on the names and sizes of its files."""
        return "-".join(fingerprint_of(images.reader.paths) for images in self._recordings)

    def __iter__(self) -> Generator[Frame, None, None]:
        """Yield the frames; the next one is read while the present one is used.

        Raises:
            InputError: there is no image of a recording that can be used.
        """
        return self.frames_after(ReadingPlace())

    def frames_after(self, place: ReadingPlace) -> Generator[Frame, None, None]:
        """Yield the frames after a reading position; like the iteration over all.

        Raises:
            InputError: the position does not fit this source.
        """
        if len(place.recordings) > len(self._recordings):
            raise InputError(f"{self.name} is not what it was when the run began.")
        return self._frames_after(place)

    def _frames_after(self, place: ReadingPlace) -> Generator[Frame, None, None]:
        self.place = place
        for number in range(max(len(place.recordings) - 1, 0), len(self._recordings)):
            yield from self._frames_of(number)

    def _frames_of(self, number: int) -> Generator[Frame, None, None]:
        """The frames of a recording after the present position."""
        images = self._recordings[number]
        previous = self.place.recordings[:number]
        here = (*self.place.recordings, RecordingPlace())[number]
        index = self.place.frames
        end = self.place.time
        last = end - here.shift
        for raw in images.read(here.read):
            here = here.after(raw)
            last = raw.timestamp
            if raw.image is None:
                self.place = ReadingPlace(index, end, (*previous, here))
                continue
            follows_cut = here.span is None and index > 0
            if here.span is None:
                shift = end + PAUSE - raw.timestamp if index else 0.0
                span = RecordingSpan(images.name, index, raw.timestamp + shift, raw.timestamp)
                here = replace(here, span=span, shift=shift)
            end = raw.timestamp + here.shift
            self.place = ReadingPlace(index + 1, end, (*previous, here))
            pose = images.poses.of(raw.timestamp, raw.pose)
            pose = None if pose is None else replace(pose, world=number)
            left = None if images.length is None else max(0, images.length - here.read)
            mask = self.mask if raw.mask is None else raw.mask
            yield Frame(index, end, raw.image, follows_cut, raw.depth, pose, raw.rows, left, mask)
            index += 1
        if not here.frames:
            raise InputError(images.why_empty(here.skipped))
        if short := images.why_short(here.read, last):
            _log.warning("%s", short)
        if here.skipped > 1:
            _log.warning("%s: skipped %d images that cannot be used.", images.name, here.skipped)
        if here.scaled > 1:
            _log.warning("%s: %d images were scaled.", images.name, here.scaled)
        if here.damaged > 1:
            _log.warning("%s: %d images are damaged.", images.name, here.damaged)


def _check_same(first: WorkingImages, other: WorkingImages) -> None:
    a, b = first.camera, other.camera
    if (a.width, a.height) != (b.width, b.height):
        raise InputError(
            f"{first.name} gives images of {a.width} x {a.height} pixels, {other.name} of "
            f"{b.width} x {b.height}; videos can be joined that were taken with one camera mode."
        )
    if abs(a.fx / b.fx - 1) > SAME or abs(a.fy / b.fy - 1) > SAME:
        raise InputError(
            f"{first.name} and {other.name} have different focal lengths ({a.fx:.0f} and "
            f"{b.fx:.0f} pixels); videos can be joined that were taken with one camera."
        )
