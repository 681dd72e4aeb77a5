"""Angular motion at each image of a video, from its flow to the neighbouring images."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from geogs.camera.shutter.angular_motion import AngularMotion, AngularStep, angular_motion_between
from geogs.camera.shutter.rates import FlowMeter, angular_velocity, parallax
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.threads import Each


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

    def stepped(
        pair: tuple[_Seen[Picture], _Seen[Picture] | None],
    ) -> tuple[_Seen[Picture], AngularStep | None]:
        first, second = pair
        if second is None or not (first.is_wanted or second.is_wanted):
            return first, None
        return first, _step(meter, first, second, readout)

    before: AngularStep | None = None
    for here, after in each(stepped, _neighbours(images, meter, wanted)):
        if here.is_wanted:
            yield here.image, angular_motion_between(before, after)
        before = after


@dataclass(frozen=True)
class _Seen(Generic[Picture]):
    """An image, its small version for flow, and whether its motion is wanted."""

    image: Picture
    small: UInt8[np.ndarray, "h w"] | None
    is_wanted: bool


def _neighbours(
    images: Iterable[Picture], meter: FlowMeter, wanted: Callable[[int], bool]
) -> Iterator[tuple[_Seen[Picture], _Seen[Picture] | None]]:
    """Yield each image with the next; the last one alone."""
    last: _Seen[Picture] | None = None
    for position, image in enumerate(images):
        small = None if image.image is None else meter.small(image.image)
        here = _Seen(image, small, wanted(position))
        if last is not None:
            yield last, here
        last = here
    if last is not None:
        yield last, None


def _step(
    meter: FlowMeter, first: _Seen[Picture], second: _Seen[Picture], readout: float
) -> AngularStep | None:
    interval = second.image.timestamp - first.image.timestamp
    if first.small is None or second.small is None or interval <= 0:
        return None
    flow = meter.measure(first.small, second.small)
    rate = angular_velocity(flow, interval, readout)
    if rate is None:
        return None
    return AngularStep(rate, interval, parallax(flow, rate, interval, readout))
