"""Working images of one recording, in order, with their times and their camera.

A format supplies a reader of stored images; :class:`WorkingImages` adds the common parts: the
selection, the calibration, the shutter, the working resolution and reading ahead.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from geogs.camera.shutter.angular_motion import AngularMotion
from geogs.camera.shutter.neighbours import with_angular_motion
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.camera.shutter.rows import RowOffsets
from geogs.camera.shutter.shutter import Shutter
from geogs.config import InputConfig
from geogs.documents import expanded
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.pictures import read_mask
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.depth_files import RecordedDepth, RectifiedDepth
from geogs.io.sources.frame_masks import FrameMasks, masked_out
from geogs.io.sources.known_intrinsics import resolve_intrinsics
from geogs.io.sources.live.live_reader import LiveReader
from geogs.io.sources.pose_priors import chosen_poses
from geogs.io.sources.reader import (
    RawFrame,
    Reader,
    SpreadReader,
    of_one_size,
    read_ahead,
    read_side_by_side,
)
from geogs.io.sources.undistort import Rectifier, mask_as_image
from geogs.threads import Each
from geogs.types import MeasuredDepth, SeenRows

LEAST_EDGE = 12
"""Least shorter side of a working image in pixels."""
MOST_OF = 0.97
"""Fraction of the announced length below which a recording is reported as cut off."""


class WorkingImages:
    """Images of a recording at working resolution, undistorted, in time order.

    The rows of a rolling shutter, where its readout is known, are rectified to the middle one.
    """

    def __init__(
        self,
        reader: Reader,
        config: InputConfig,
        calibration: Calibration | None = None,
        shutter: Shutter | None = None,
        focal: float | None = None,
        overlay: Bool[np.ndarray, "h w"] | None = None,
    ) -> None:
        """``calibration`` of the upright images, instead of the reader's.

        ``shutter``, instead of the settings'; ``focal`` of the working images, instead of the
        settings'; ``overlay``, true where all images at working size show a static overlay.
        """
        info = reader.info
        _check_selection(config, info.length)
        if config.depth == "sensor" and not info.has_depth:
            why = f": {info.depth_fault}" if info.depth_fault else ""
            raise InputError(
                f"{info.name} has no depth of a sensor beside its images that can be read here"
                f"{why}; leave out --depth, or give that of the images."
            )
        self.poses = chosen_poses(config.poses, info)
        """Pose priors beside the images."""
        self.reader = reader
        """Reads the stored images."""
        self.name = info.name
        """Name of the sequence."""
        self.fps = info.fps / config.stride
        """Frames per second after the stride, nominal."""
        self._config = config
        self.calibration = calibration or resolve_intrinsics(
            config.intrinsics, info.calibration, info.width, info.height, info.quarter_turns
        )
        """The camera of the images as stored, upright, with its distortion."""
        given = Shutter() if config.readout == "auto" else Shutter(config.readout, "as given")
        self.shutter = shutter or given
        """The shutter by which rows are rectified; a global one until it is estimated."""
        self._focal = focal
        self._rectifier = Rectifier(self.calibration, config.long_edge, config.field_of_view, focal)
        self.camera = self._rectifier.camera
        """The pinhole camera of the working images."""
        check_large_enough(self.camera, info.name)
        masks = None if config.mask is None else expanded(config.mask)
        self._masks = FrameMasks(masks) if masks is not None and masks.is_dir() else None
        self.mask: Bool[np.ndarray, "h w"] | None = None
        """Valid pixels of every frame; none where all are valid."""
        if masks is not None and self._masks is None:
            self.mask = self._straight(read_mask(masks, (info.height, info.width)))
        elif overlay is not None:
            self.mask = self._straight(~overlay)
        self._overlay = overlay
        self.black_is_masked = self._masks is not None
        """Whether black pixels of frames are masked out."""
        self.is_live = isinstance(reader, LiveReader)
        """Whether the source is live."""
        self.uses_depth = config.depth != "none" and info.has_depth
        """Whether images have sensor depth."""

    def _straight(self, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h2 w2"]:
        """Undistort a mask of an image as stored, or at working size, like an image."""
        return mask_as_image(self._rectifier, mask)

    @property
    def depth_found(self) -> str:
        """A sentence on the sensor depth."""
        info = self.reader.info
        if info.has_depth:
            of = "" if info.length is None else f" of {info.length}"
            return f"The depth of a sensor beside {info.name} is used: {info.depths}{of} images."
        why = info.depth_fault or "none lies beside the images, or none that can be read here"
        return f"No depth of a sensor is used for {info.name}: {why}."

    @property
    def is_calibration_open(self) -> bool:
        """Whether the focal length is a guess or nominal, not given by user or data set."""
        asked = self._config.intrinsics.strip().lower() == "auto"
        return asked and (self.calibration.is_guess or self.calibration.is_nominal)

    def known_better(
        self,
        calibration: Calibration | None = None,
        shutter: Shutter | None = None,
        focal: float | None = None,
        overlay: Bool[np.ndarray, "h w"] | None = None,
    ) -> "WorkingImages":
        """The same images with another calibration, another readout, another focal length of the
        working camera, or a static overlay masked out."""
        info = self.reader.info
        known = calibration.fit(info.width, info.height) if calibration else self.calibration
        return WorkingImages(
            self.reader, self._config, known, shutter or self.shutter, focal or self._focal,
            self._overlay if overlay is None else overlay,
        )  # fmt: skip

    def as_recorded(self) -> "WorkingImages":
        """All images of the selection at stride 1, without row rectification."""
        config = replace(self._config, stride=1)
        return WorkingImages(
            self.reader, config, self.calibration, Shutter(), self._focal, self._overlay
        )

    def spread(self, count: int) -> Iterator[RawFrame]:
        """Read ``count`` images spread over the selection, at working size, lens and rows as
        stored; fewer, or none, where the recording can only be read from its beginning."""
        config, length = self._config, self.reader.info.length
        if length is None and self.reader.info.seconds is not None:
            length = round(self.reader.info.seconds * self.reader.info.fps)
        if length is None or not isinstance(self.reader, SpreadReader):
            return iter(())
        places = np.arange(length)[config.start : config.stop]
        chosen = places[np.unique(np.linspace(0, len(places) - 1, count).round().astype(int))]
        return map(self._at_working_size, self.reader.spread(chosen.tolist()))

    @property
    def is_overlay_open(self) -> bool:
        """Whether no mask was given, and static overlays may be masked out."""
        return self._config.mask is None and self._config.mask_overlay and not self.is_live

    @property
    def is_shutter_open(self) -> bool:
        """Whether the readout is not known yet, and can be estimated from the frames."""
        return not self.is_live and self._config.readout == "auto" and self.shutter == Shutter()

    @property
    def rolling_camera(self) -> RollingCamera:
        """The camera of the images at working size, lens and rows as stored."""
        info = self.reader.info
        turns = info.quarter_turns
        lines = info.width if turns % 2 else info.height
        return self._rectifier.rolling_camera(lines, turns)

    def _at_working_size(self, raw: RawFrame) -> RawFrame:
        """The image at working size, lens and rows as stored."""
        raw = of_one_size(raw, self.reader.info)
        if raw.image is None:
            return raw
        return replace(raw, image=self._rectifier.resized(raw.image))

    @property
    def length(self) -> int | None:
        """Expected number of images, unreadable ones included; none where not known beforehand."""
        config, length = self._config, self.reader.info.length
        if length is None:
            return None
        return len(range(length)[config.start : config.stop : config.stride])

    def read(self, first: int) -> Iterator[RawFrame]:
        """Read the selection from its ``first`` image on; unless it is live, the next one is read
        while the present one is used."""
        images = self._masked(self._working(first))
        return images if self.is_live else read_ahead(images)

    def _working(self, first: int) -> Iterator[RawFrame]:
        """The working images of the selection from its ``first`` on."""
        config, reader = self._config, self.reader
        start = config.start + first * config.stride
        if self.shutter.readout:
            yield from self._with_rows_rectified(start)
            return
        rows = self._open_rows()
        for raw in reader.read(start, config.stop, config.stride):
            raw = of_one_size(raw, reader.info)
            if raw.image is not None:
                image = self._rectifier(raw.image)
                raw = replace(raw, image=image, depth=self._rectified(raw.depth), rows=rows)
            yield raw

    def _open_rows(self) -> SeenRows | None:
        """Row times of any image by the readout's error; none for a known global shutter.

        It is the same for all images and kept once.
        """
        error = self.shutter.error
        if error == 0:
            return None
        offsets = RowOffsets(self.rolling_camera, self.camera)
        still = offsets.nodes(AngularMotion(), 0.0)
        seen = offsets.seen(still, Shutter(error, error=error))
        return replace(seen, is_rectified=False)

    def _masked(self, working: Iterator[RawFrame]) -> Iterator[RawFrame]:
        """Working images with masked-out pixels black, by their own masks."""
        for raw in working:
            if self._masks is None or raw.image is None:
                yield raw
                continue
            valid = self._masks.read(raw.name, (self.reader.info.height, self.reader.info.width))
            straight = None if valid is None else self._straight(valid)
            yield replace(raw, image=masked_out(raw.image, straight), mask=straight)

    def _rectified(
        self, depth: MeasuredDepth | None, moved: Float[np.ndarray, "h w 2"] | None = None
    ) -> MeasuredDepth | None:
        """Stored depth for the pixels of a working image; ``moved`` are its row offsets."""
        if not (self.uses_depth and isinstance(depth, RecordedDepth)):
            return None
        return RectifiedDepth(depth, self.calibration, self._rectifier, moved)

    def _with_rows_rectified(self, start: int) -> Iterator[RawFrame]:
        """Working images of a rolling shutter, from an index of the source on.

        Rotation is measured between neighbours in the source, whatever the stride, and the
        image before the first is read, too.
        """
        config, rolling, readout = self._config, self.rolling_camera, self.shutter.readout
        before = min(start, 1)
        stop = None if config.stop is None else config.stop + 1

        def is_selected(position: int) -> bool:
            after = position - before
            inside = config.stop is None or start + after < config.stop
            return after >= 0 and after % config.stride == 0 and inside

        images = map(self._at_working_size, self.reader.read(start - before, stop, 1))
        offsets = RowOffsets(rolling, self.camera)

        def straight(seen: tuple[RawFrame, AngularMotion]) -> RawFrame:
            raw, turning = seen
            if raw.image is None:
                return raw
            nodes = offsets.nodes(AngularMotion() if turning.is_still else turning, readout)
            moved = None if turning.is_still else offsets.dense(nodes)
            image = self._rectifier.straightened(raw.image, moved)
            depth, rows = self._rectified(raw.depth, moved), offsets.seen(nodes, self.shutter)
            return replace(raw, image=image, depth=depth, rows=rows)

        each: Each = map if self.is_live else read_side_by_side
        yield from each(straight, with_angular_motion(images, rolling, readout, is_selected, each))

    def why_short(self, read: int, last: float) -> str:
        """Message if fewer images came than the recording announces; empty if all came.

        Args:
            read: number of images of the selection, unusable ones included.
            last: time of the last one, seconds.
        """
        seconds = None if self._config.stop is not None else self.reader.info.seconds
        if self.length is not None and read < MOST_OF * self.length - 1:
            missing = f"says that it has {self.length} images here, but only {read} came"
        elif seconds is not None and last < MOST_OF * seconds - 0.5:
            missing = f"says that it lasts {seconds:.1f} s, but its images end at {last:.1f} s"
        else:
            return ""
        return f"{self.name} {missing}; is it cut off?"

    def why_empty(self, skipped: int) -> str:
        """Message where all images were skipped, or there are none."""
        if skipped:
            return f"{self.name}: none of its {skipped} images can be used."
        return f"{self.name} ends before frame {self._config.start}; give a smaller start."


def _check_selection(config: InputConfig, length: int | None) -> None:
    if length is not None and config.start >= length:
        raise InputError(
            f"start is {config.start}, but the source has only {length} frames; give a smaller one."
        )


def check_large_enough(camera: Camera, name: str) -> None:
    """Raise InputError where working images are too small for tracking."""
    if min(camera.width, camera.height) < LEAST_EDGE:
        raise InputError(
            f"{name} gives working images of {camera.width}x{camera.height} pixels; both sides "
            f"need {LEAST_EDGE} at least, so give larger images or a larger --long-edge."
        )
