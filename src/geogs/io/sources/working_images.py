"""Working images of one recording, in order, with their times and their camera.

A format supplies a reader of stored images; :class:`WorkingImages` adds the common parts: the
selection, the calibration, the shutter, the working resolution and reading ahead.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float

from geogs.camera.shutter.angular_motion import AngularMotion
from geogs.camera.shutter.rates import with_angular_motion
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.camera.shutter.rows import RowOffsets
from geogs.camera.shutter.shutter import Shutter
from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.guard.documents import expanded
from geogs.io.pictures import read_mask
from geogs.io.sources.account import Account
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.depth_check import ANCHORS, STEPS, MeasuredView, ratio_to_depth
from geogs.io.sources.depth_files import RecordedDepth, RectifiedDepth
from geogs.io.sources.depth_unit import ChosenDepth, chosen_depth
from geogs.io.sources.frame_masks import FrameMasks, masked_out
from geogs.io.sources.known_intrinsics import resolve_intrinsics
from geogs.io.sources.live.live_reader import LiveReader
from geogs.io.sources.pose_clock import Turning, on_clock, turning_rates
from geogs.io.sources.pose_priors import ChosenPoses, chosen_poses
from geogs.io.sources.reader import (
    RawFrame,
    Reader,
    SpreadReader,
    of_one_size,
    read_ahead,
    read_side_by_side,
)
from geogs.io.sources.selection import selection_of
from geogs.io.sources.undistort import Rectifier, mask_as_image, window_around
from geogs.threads import Each
from geogs.types import MeasuredDepth, SeenRows

LEAST_EDGE = 12
"""Least shorter side of a working image in pixels."""
MOST_COMPARED = 600
"""Largest number of images whose motion is compared with that of given poses."""
MOST_OF = 0.97
"""Fraction of the announced length below which a recording is reported as cut off."""


class WorkingImages:
    """Images of a recording at working resolution, with their lens, in time order.

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
        poses: ChosenPoses | None = None,
        depth: ChosenDepth | None = None,
        keeps_lens: bool = True,
    ) -> None:
        """``calibration`` of the upright images, instead of the reader's.

        ``shutter``, instead of the settings'; ``focal`` of the working images, instead of the
        settings'; ``overlay``, true where all images at working size show a static overlay;
        ``poses`` by the clock of the images, and ``depth``, instead of the settings'. Without
        ``keeps_lens`` images are made straight.
        """
        info = reader.info
        self._selection = selection_of(config, info.fps)
        if info.length is not None and self._selection.start >= info.length:
            raise InputError(
                f"start is {config.start}, but the source has only {info.length} frames; give a "
                "smaller one."
            )
        self.reader = reader
        """Reads the stored images."""
        self.name = info.name
        """Name of the sequence."""
        self.fps = info.fps / config.stride
        """Frames per second after the stride, nominal."""
        self._config = config
        self.calibration = calibration or resolve_intrinsics(
            config.intrinsics,
            info.calibration,
            info.width,
            info.height,
            info.quarter_turns,
            info.pixel_aspect,
        )
        """The camera of the images as stored, upright, with its distortion."""
        given = Shutter() if config.readout == "auto" else Shutter(config.readout, "as given")
        self.shutter = shutter or given
        """The shutter by which rows are rectified; a global one until it is estimated."""
        self._focal = focal
        masks = None if config.mask is None else expanded(config.mask)
        self._masks = FrameMasks(masks) if masks is not None and masks.is_dir() else None
        valid = None if overlay is None else ~overlay
        if masks is not None and self._masks is None:
            valid = read_mask(masks, (info.height, info.width))
        self._keeps_lens = keeps_lens and focal is None
        rectify = partial(
            Rectifier,
            self.calibration,
            config.long_edge,
            config.working_field_of_view,
            focal,
            keeps_lens=self._keeps_lens,
        )
        self._rectifier = rectify()
        if valid is not None:
            window = window_around(mask_as_image(self._rectifier, valid))
            self._rectifier = self._rectifier if window is None else rectify(window=window)
        self.camera = self._rectifier.camera
        """The pinhole of straight images: of the part that holds all valid pixels."""
        self.image_camera = self._rectifier.image_camera
        """The camera of the working images, with its lens unless they are straight."""
        check_large_enough(self.camera, info.name)
        self.mask: Bool[np.ndarray, "h w"] | None = (
            None if valid is None else mask_as_image(self._rectifier, valid)
        )
        """Valid pixels of every frame; none where all are valid."""
        self._overlay = overlay
        self.black_is_masked = self._masks is not None
        """Whether black pixels of frames are masked out."""
        self.is_live = isinstance(reader, LiveReader)
        """Whether the source is live."""
        self.poses = poses or self._on_clock(chosen_poses(config.poses, info))
        """Pose priors beside the images."""
        self.depth = depth or chosen_depth(config, info)
        """Sensor depth beside the images."""
        if depth is None:
            ratio = ratio_to_depth(self._measured_pairs(), self.camera)
            self.depth = self.depth.checked(ratio, self.is_calibration_open, info.name)

    @property
    def account(self) -> Account:
        """Findings beside the images: those used, and those not used with the reason."""
        info = self.reader.info
        own = Account((self.calibration.sentence,))
        beside = self.depth.account + self.poses.account
        return own + beside + self.calibration.account + info.account

    def _on_clock(self, poses: ChosenPoses) -> ChosenPoses:
        """Poses of a file by the clock of the images. Raises InputError if the clocks share no time
        and nothing tells by how much they differ."""
        length = self.reader.info.length
        if poses.file is None or self.is_live or length is None:
            return poses

        def turning() -> Turning:
            images = map(self._at_working_size, self.reader.read(0, MOST_COMPARED, 1))
            return turning_rates(images, self.rolling_camera)

        first, last = self.reader.info.first_time, self.reader.info.last_time
        trajectory, change = on_clock(poses.file, first, last, turning, self._config.poses)
        said = Account((f"poses: {change}",) if change else ())
        return replace(poses, file=trajectory, account=poses.account + said)

    def _measured_pairs(self) -> Iterator[tuple[MeasuredView, MeasuredView]]:
        """Pairs of images with depth and pose, spread over the recording; none without priors."""
        length = self.reader.info.length or 0
        is_both = self.depth.is_used and self.poses.is_used
        if not (is_both and isinstance(self.reader, SpreadReader)):
            return
        for one, two in itertools.product(np.linspace(0, length, ANCHORS + 2)[1:-1], STEPS):
            chosen = [n for n in (int(one), int(one) + two) if n < length]
            views = [self._measured_view(raw) for raw in self.reader.spread(chosen)]
            if len(views) == 2 and views[0] is not None and views[1] is not None:
                yield views[0], views[1]

    def _measured_view(self, raw: RawFrame) -> MeasuredView | None:
        """An image with its depth and pose, rows as stored; none where one is missing."""
        raw = of_one_size(raw, self.reader.info)
        pose = self.poses.of(raw.timestamp, raw.pose)
        depth = self._rectified(raw.depth)
        metres = None if depth is None else depth.metres()
        if raw.image is None or pose is None or metres is None:
            return None
        grey = cv2.cvtColor(self._rectifier(raw.image), cv2.COLOR_RGB2GRAY)
        return MeasuredView(grey, metres, pose.T_cw.numpy())

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
        stride: int | None = None,
        keeps_lens: bool | None = None,
    ) -> "WorkingImages":
        """The same images with another calibration, another readout, another focal length of the
        working camera, a static overlay masked out, at another stride, or with or without their
        lens."""
        info = self.reader.info
        return WorkingImages(
            self.reader,
            replace(self._config, stride=stride or self._config.stride),
            calibration.fit(info.width, info.height) if calibration else self.calibration,
            shutter or self.shutter,
            focal or self._focal,
            self._overlay if overlay is None else overlay,
            self.poses,
            self.depth,
            self._keeps_lens if keeps_lens is None else keeps_lens,
        )

    def as_recorded(self) -> "WorkingImages":
        """All images of the selection at stride 1, straight, without row rectification."""
        return self.known_better(shutter=Shutter(), stride=1, keeps_lens=False)

    def spread(self, count: int) -> Iterator[RawFrame]:
        """Read ``count`` images spread over the selection, at working size, lens and rows as
        stored; over its beginning where a recording cannot be entered at enough places."""
        if self.is_live:
            return iter(())
        info = self.reader.info
        chosen = self._selection
        length = info.length
        if length is None and info.seconds is not None:
            length = round(info.seconds * info.fps)
        places = range(length or chosen.start + MOST_COMPARED)[chosen.start : chosen.stop]
        if length and places and isinstance(self.reader, SpreadReader):
            numbers = np.unique(np.linspace(0, len(places) - 1, count).round().astype(int))
            entered = self.reader.spread([places[k] for k in numbers.tolist()])
            found = list(map(self._at_working_size, entered))
            if 2 * len(found) >= count:
                return iter(found)
        beginning = places[:MOST_COMPARED]
        step = max(len(beginning) // count, 1)
        stop = chosen.start + len(beginning)
        return map(self._at_working_size, self.reader.read(chosen.start, stop, step))

    @property
    def takes(self) -> str:
        """Part of the images that is used, as the settings name it."""
        return self._config.take

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
        length = self.reader.info.length
        if length is None:
            return None
        chosen = self._selection
        return len(range(length)[chosen.start : chosen.stop : chosen.stride])

    def read(self, first: int) -> Iterator[RawFrame]:
        """Read the selection from its ``first`` image on; unless it is live, the next one is read
        while the present one is used."""
        images = self._masked(self._working(first))
        return images if self.is_live else read_ahead(images)

    def _working(self, first: int) -> Iterator[RawFrame]:
        """The working images of the selection from its ``first`` on."""
        chosen = self._selection
        reader = self.reader
        start = chosen.start + first * chosen.stride
        if self.shutter.readout:
            yield from self._with_rows_rectified(start)
            return
        rows = self._open_rows()
        for raw in reader.read(start, chosen.stop, chosen.stride):
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
        offsets = RowOffsets(self.rolling_camera, self.image_camera)
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
            straight = None if valid is None else mask_as_image(self._rectifier, valid)
            yield replace(raw, image=masked_out(raw.image, straight), mask=straight)

    def _rectified(
        self, depth: MeasuredDepth | None, moved: Float[np.ndarray, "h w 2"] | None = None
    ) -> MeasuredDepth | None:
        """Stored depth for the pixels of a working image; ``moved`` are its row offsets."""
        if not (self.depth.is_used and isinstance(depth, RecordedDepth)):
            return None
        return RectifiedDepth(self.depth.of(depth), self.calibration, self._rectifier, moved)

    def _with_rows_rectified(self, start: int) -> Iterator[RawFrame]:
        """Working images of a rolling shutter, from an index of the source on.

        Rotation is measured between neighbours in the source, whatever the stride, and the
        image before the first is read, too.
        """
        chosen = self._selection
        rolling = self.rolling_camera
        readout = self.shutter.readout
        before = min(start, 1)
        stop = None if chosen.stop is None else chosen.stop + 1
        end = math.inf if chosen.stop is None else chosen.stop - start

        def is_selected(position: int) -> bool:
            after = position - before
            return 0 <= after < end and after % chosen.stride == 0

        images = map(self._at_working_size, self.reader.read(start - before, stop, 1))
        offsets = RowOffsets(rolling, self.image_camera)

        def straight(seen: tuple[RawFrame, AngularMotion]) -> RawFrame:
            raw, turning = seen
            if raw.image is None:
                return raw
            nodes = offsets.nodes(AngularMotion() if turning.is_still else turning, readout)
            moved = None if turning.is_still else offsets.dense(nodes)
            image = self._rectifier.straightened(raw.image, moved)
            depth = self._rectified(raw.depth, moved)
            rows = offsets.seen(nodes, self.shutter)
            return replace(raw, image=image, depth=depth, rows=rows)

        each: Each = map if self.is_live else read_side_by_side
        yield from each(straight, with_angular_motion(images, rolling, readout, is_selected, each))

    def why_short(self, read: int, last: float) -> str:
        """Message if fewer images came than the recording announces; empty if all came.

        Args:
            read: number of images of the selection, unusable ones included.
            last: time of the last one, seconds.
        """
        seconds = None if self._selection.stop is not None else self.reader.info.seconds
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
        if not self._selection.start:
            return f"{self.name} ended before its first image."
        return f"{self.name} ends before frame {self._selection.start}; give a smaller start."


def check_large_enough(camera: Camera, name: str) -> None:
    """Raise InputError where working images are too small for tracking."""
    if min(camera.width, camera.height) < LEAST_EDGE:
        raise InputError(
            f"{name} gives working images of {camera.width}x{camera.height} pixels; both sides "
            f"need {LEAST_EDGE} at least, so give larger images or a larger --long-edge."
        )
