"""Angular velocity of a camera at the images of a video, from the flow between neighbours."""

import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, pairwise
from typing import Generic, Protocol, TypeVar, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from geogs.camera.shutter.angular_motion import (
    AngularMotion,
    AngularStep,
    angular_motion_between,
    rotated,
)
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.threads import Each

LONG_EDGE = 256
"""Largest long edge, in pixels, of the images for flow."""
STEP = 8
"""Pixels of these images between two cells."""
BORDER = 2
"""Pixels from the border within which flow ends are not used."""
TOLERANCE = 0.004
"""Radians by which a cell may differ from rotation before it loses half of its weight."""
SMOOTH = 1.0
"""Standard deviation of the smoothing of parallax, in cells."""
AGREEING = 0.2
"""Fraction of the cells that have to agree with the rotation within twice the tolerance."""


@dataclass(frozen=True)
class RayFlow:
    """Matches of the cells of one image with another, as rays of the two cameras."""

    first: Float[np.ndarray, "n 3"]
    """Unit vectors in the first camera."""
    second: Float[np.ndarray, "n 3"]
    """Unit vectors in the second camera."""
    first_time: Float[np.ndarray, "n"]
    """Readouts from the middle row of the first image to the row of the cell."""
    second_time: Float[np.ndarray, "n"]
    """The same in the second image."""
    inside: Bool[np.ndarray, "n"]
    """Whether the flow ends within the second image."""
    ends: Float[np.ndarray, "n 2"]
    """End positions, in pixels of the small second image."""
    shape: tuple[int, int]
    """Rows and columns of the cells."""


class FlowMeter:
    """Measures flow between images of one camera, in any thread."""

    def __init__(self, camera: RollingCamera) -> None:
        """``camera``: that of the images passed to :meth:`small`."""
        full = camera.camera
        small = full if full.long_edge <= LONG_EDGE else full.with_long_edge(LONG_EDGE)
        self._size = (small.width, small.height)
        self._camera = replace(camera, camera=small)
        v, u = np.mgrid[STEP // 2 : small.height : STEP, STEP // 2 : small.width : STEP]
        self._cells = v, u
        self._pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
        self._rays = self._camera.rays(self._pixels)
        self._times = self._camera.line_times(self._pixels)
        self._of_thread = threading.local()

    def small(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2"]:
        """Return the small grey image for flow."""
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if (grey.shape[1], grey.shape[0]) == self._size:
            return grey
        return cv2.resize(grey, self._size, interpolation=cv2.INTER_AREA)

    def measure(self, first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]) -> RayFlow:
        """Measure flow from one small image to another."""
        # OpenCV's own has buffers that two threads cannot share.
        if not hasattr(self._of_thread, "dis"):
            self._of_thread.dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        dense = self._of_thread.dis.calc(first, second, None)
        ends = self._pixels + dense[self._cells].reshape(-1, 2)
        width, height = self._size
        last = width - 1 - BORDER, height - 1 - BORDER
        inside = ((ends >= BORDER) & (ends <= last)).all(1)
        ends = np.where(inside[:, None], ends, self._pixels)
        rays = self._camera.rays(ends)
        times = self._camera.line_times(ends)
        return RayFlow(self._rays, rays, self._times, times, inside, ends, self._cells[0].shape)


def angular_velocity(
    flow: RayFlow, interval: float, readout: float
) -> Float[np.ndarray, "3"] | None:
    """Estimate mean radians per second between the middle rows of two images, in camera axes.

    The rotation that most cells agree on, by iteratively reweighted least squares (Cauchy's
    weights, Procrustes' rotation), compiled. Each round has a closed-form solution, so the common
    least-squares loop is not used. A point lies in different rows of the two images, so the time
    between is more or less than the interval: its rays are moved to the times of the middle rows by
    the velocity itself.

    Args:
        flow: from the first image to the second.
        interval: seconds between the two.
        readout: seconds from the first to the last row.

    Returns:
        the velocity; None where too few cells agree.
    """
    from geogs.camera.shutter.turning_kernels import turning_between

    first_time = readout * flow.first_time
    second_time = readout * flow.second_time
    rate, error = turning_between(
        flow.first,
        flow.second,
        first_time,
        second_time,
        flow.inside.astype(np.float64),
        interval,
        tolerance=TOLERANCE,
        rounds=10,
    )
    agreeing = (flow.inside & (error < 2 * TOLERANCE)).mean()
    return rate if agreeing >= AGREEING else None


def parallax(
    flow: RayFlow, rate: Float[np.ndarray, "3"], interval: float, readout: float
) -> tuple[Float[np.ndarray, "gh gw 2"], Float[np.ndarray, "gh gw 2"]]:
    """Return the motion of the cells beyond a rotation, in the first image and moved to the second.

    It is due to the camera's translation, by the depth of each cell, and to moving objects. It is
    smoothed over neighbouring cells, by a median and a mean, and filled in from them where unknown.

    Args:
        flow: from the first image to the second.
        rate: of the rotation, radians per second.
        interval: seconds between the two.
        readout: seconds from the first to the last row.

    Returns:
        x/z and y/z per second at the cells.
    """
    first, second = (
        rotated(rays, -readout * times[:, None] * rate)
        for rays, times in ((flow.first, flow.first_time), (flow.second, flow.second_time))
    )
    turned = rotated(first, np.repeat(interval * rate[None], len(first), axis=0))
    known = flow.inside & (turned[:, 2] > 0.1) & (second[:, 2] > 0.1)
    between = interval + readout * (flow.second_time - flow.first_time)
    ahead = (rays[:, :2] / np.maximum(rays[:, 2:], 0.1) for rays in (second, turned))
    velocity = np.subtract(*ahead) / between[:, None]
    lines, columns = flow.shape
    field = np.where(known[:, None], velocity, 0).astype(np.float32).reshape(lines, columns, 2)
    field = np.dstack([cv2.medianBlur(part.copy(), 5) for part in np.moveaxis(field, 2, 0)])
    ends = np.rint((flow.ends - STEP // 2) / STEP).astype(int)
    column, row = np.clip(ends, 0, [columns - 1, lines - 1]).T
    there = row * columns + column
    return _spread(field, known, np.arange(len(there))), _spread(field, known, there)


def _spread(
    field: Float[np.ndarray, "gh gw 2"], known: Bool[np.ndarray, "n"], cells: Int[np.ndarray, "n"]
) -> Float[np.ndarray, "gh gw 2"]:
    """Move each value to its cell, then average the known values around each cell."""
    shape = field.shape[:2]
    count = len(cells)
    values = (known, *(known * part for part in field.reshape(-1, 2).T))
    laid = (np.bincount(cells, part, count).reshape(shape) for part in values)
    weight, *sums = (cv2.GaussianBlur(part, (0, 0), SMOOTH) for part in laid)
    return np.dstack(sums) / np.maximum(weight, 1e-3)[..., None]


@runtime_checkable
class Image(Protocol):
    """An image of a video."""

    @property
    def timestamp(self) -> float:
        """Seconds."""
        ...

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"] | None:
        """RGB, of the camera whose motion is estimated; None if it could not be read."""
        ...


Picture = TypeVar("Picture", bound=Image)


def with_angular_motion(
    images: Iterable[Picture],
    camera: RollingCamera,
    readout: float,
    wanted: Callable[[int], bool],
    each: Each = map,
) -> Iterator[tuple[Picture, AngularMotion]]:
    """Yield the wanted images, each with the angular motion of the camera.

    The result depends on an image and its two neighbours alone, so it is the same wherever reading
    begins.

    Args:
        images: neighbours in the video.
        camera: that took them.
        readout: seconds from the first to the last row.
        wanted: whether the image at position 0, 1, 2, ... is wanted.
        each: maps flow measurement over pairs of neighbours; with ``map`` one image more than the
            one yielded has been read by then.
    """
    meter = FlowMeter(camera)
    seen = (
        _Seen(image, None if image.image is None else meter.small(image.image), wanted(position))
        for position, image in enumerate(images)
    )
    before: AngularStep | None = None
    for here, after in each(partial(_step, meter, readout), pairwise(chain(seen, [None]))):
        if here.is_wanted:
            yield here.image, angular_motion_between(before, after)
        before = after


@dataclass(frozen=True)
class _Seen(Generic[Picture]):
    """An image, its small version for flow, and whether its motion is wanted."""

    image: Picture
    small: UInt8[np.ndarray, "h w"] | None
    is_wanted: bool


def _step(
    meter: FlowMeter, readout: float, pair: tuple[_Seen[Picture] | None, _Seen[Picture] | None]
) -> tuple[_Seen[Picture], AngularStep | None]:
    """Return the first of two neighbours, with the motion to the second; None where it is unknown
    or not wanted. The last image has no second."""
    first, second = pair
    assert first is not None
    if second is None or not (first.is_wanted or second.is_wanted):
        return first, None
    interval = second.image.timestamp - first.image.timestamp
    if first.small is None or second.small is None or interval <= 0:
        return first, None
    flow = meter.measure(first.small, second.small)
    rate = angular_velocity(flow, interval, readout)
    if rate is None:
        return first, None
    return first, AngularStep(rate, interval, parallax(flow, rate, interval, readout))
