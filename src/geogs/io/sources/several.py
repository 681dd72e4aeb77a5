"""Several videos of one place, taken with one camera, as a single stream."""

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.frame_source import ReadingPlace, Source
from geogs.io.sources.reader import RawFrame
from geogs.shutter.rolling_camera import RollingCamera
from geogs.shutter.shutter import Shutter
from geogs.types import Frame

PAUSE = 1.0
"""Seconds between the last frame of a source and the first of the next, in the joint time."""
SAME = 0.01
"""Relative difference up to which two focal lengths count as one."""


@dataclass(frozen=True, slots=True)
class SourceSpan:
    """One source within the joint stream."""

    name: str
    first_frame: int
    first_time: float
    """Seconds, in the joint time."""
    own_time: float
    """Time of its first frame in its own clock."""


@dataclass(frozen=True, slots=True)
class JointPlace:
    """How far several sources have been read."""

    frames: int = 0
    """Given, of all together."""
    time: float = 0.0
    """Time of the last, seconds in the joint time."""
    spans: tuple[SourceSpan, ...] = ()
    """Sources that were begun."""
    places: tuple[ReadingPlace, ...] = ()
    """In each of these."""


class SeveralSources:
    """Frames of several sources one after the other, numbered and timed through.

    No motion links the first frame of a source to the last of the one before.
    """

    def __init__(self, sources: Sequence[Source]) -> None:
        """Raises InputError if the cameras differ."""
        self._sources = list(sources)
        first = self._sources[0]
        for other in self._sources[1:]:
            _check_same(first, other)
        self.spans: list[SourceSpan] = []
        """Where each source that was read so far begins, in this iteration."""
        self.place = JointPlace()
        """How far the sources have been read, at each frame of this iteration."""

    @property
    def name(self) -> str:
        """Names of all."""
        return " + ".join(s.name for s in self._sources)

    @property
    def kind(self) -> str:
        """The format of the first."""
        return self._sources[0].kind

    @property
    def camera(self) -> Camera:
        """The pinhole camera of every frame."""
        return self._sources[0].camera

    @property
    def calibration(self) -> Calibration:
        """The camera of the first source's images as they came."""
        return self._sources[0].calibration

    @property
    def intrinsics_origin(self) -> str:
        """Where the intrinsics come from."""
        return self._sources[0].intrinsics_origin

    @property
    def is_calibration_open(self) -> bool:
        """Whether the focal length of any is a guess or nominal, and nobody gave it."""
        return any(s.is_calibration_open for s in self._sources)

    def with_calibration(self, calibration: Calibration) -> "SeveralSources":
        """The same frames, undistorted by another calibration of the images as they came."""
        return SeveralSources([s.with_calibration(calibration) for s in self._sources])

    @property
    def uses_depth(self) -> bool:
        """Whether frames of any come with the depth that a sensor measured."""
        return any(s.uses_depth for s in self._sources)

    @property
    def uses_poses(self) -> bool:
        """Whether frames of any come with poses of another tracker."""
        return any(s.uses_poses for s in self._sources)

    @property
    def shutter(self) -> Shutter:
        """By which rows are rectified."""
        return self._sources[0].shutter

    @property
    def mask(self) -> Bool[np.ndarray, "h w"] | None:
        """Pixels of every frame that may show the scene; none where all do."""
        return self._sources[0].mask

    @property
    def black_is_masked(self) -> bool:
        """Whether pixels that are quite black are masked out."""
        return self._sources[0].black_is_masked

    @property
    def is_live(self) -> bool:
        """Never: what does not wait is read alone."""
        return False

    @property
    def dropped(self) -> int:
        """None."""
        return 0

    @property
    def is_shutter_open(self) -> bool:
        """Whether nobody has said yet how long the readout takes."""
        return self._sources[0].is_shutter_open

    def with_shutter(self, shutter: Shutter) -> "SeveralSources":
        """The same frames, with their rows rectified by another readout."""
        return SeveralSources([s.with_shutter(shutter) for s in self._sources])

    @property
    def rolling_camera(self) -> RollingCamera:
        """The camera of the images that :meth:`clips` gives."""
        return self._sources[0].rolling_camera

    def clips(self) -> Generator[list[RawFrame], None, None]:
        """Neighbouring images of the first source, see there."""
        return self._sources[0].clips()

    def linked_frames(self) -> Generator[Frame, None, None]:
        """The frames of the first source."""
        return self._sources[0].linked_frames()

    @property
    def length(self) -> int | None:
        """Frames to expect; none where it is not known of every source."""
        lengths = [s.length for s in self._sources]
        return None if None in lengths else sum(n for n in lengths if n is not None)

    @property
    def skipped(self) -> int:
        """Images that could not be read, so far in this iteration."""
        return sum(s.skipped for s in self._sources)

    @property
    def damaged(self) -> int:
        """Images of which a part is damaged, so far in this iteration."""
        return sum(s.damaged for s in self._sources)

    def fingerprint(self) -> str:
        """Changes with the names and sizes of the files of any."""
        return "-".join(s.fingerprint() for s in self._sources)

    def __iter__(self) -> Generator[Frame, None, None]:
        """Yield the frames of all. Raises InputError as each of them does."""
        return self.frames_after(JointPlace())

    def frames_after(self, place: JointPlace) -> Generator[Frame, None, None]:
        """Yield the frames after a place; otherwise as the iteration over all."""
        self.spans = list(place.spans)
        index, end = place.frames, place.time
        for n, source in enumerate(self._sources):
            if n < len(place.places) - 1:
                source.skipped, source.damaged = place.places[n].skipped, place.places[n].damaged
                source.place = place.places[n]
                continue
            is_begun = n < len(place.places)
            begin = place.places[n] if is_begun else ReadingPlace()
            shift = self.spans[n].first_time - self.spans[n].own_time if is_begun else None
            for frame in source.frames_after(begin):
                starts = shift is None
                if shift is None:
                    shift = end + PAUSE - frame.timestamp if index else 0.0
                    time = frame.timestamp + shift
                    self.spans.append(SourceSpan(source.name, index, time, frame.timestamp))
                end = frame.timestamp + shift
                places = tuple(s.place for s in self._sources[: n + 1])
                self.place = JointPlace(index + 1, end, tuple(self.spans), places)
                pose = None if frame.pose is None else replace(frame.pose, world=n)
                yield replace(
                    frame, index=index, timestamp=end, follows_cut=starts and index > 0, pose=pose
                )
                index += 1


def _check_same(first: Source, other: Source) -> None:
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
