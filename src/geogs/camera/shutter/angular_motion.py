"""Rotation of a camera while it reads one image."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class AngularMotion:
    """Angular velocity around the time of the middle row, in axes of the camera.

    A point at X in the camera then is at ``Exp(rate t + acceleration t^2 / 2) X`` after ``t``
    seconds, as far as the camera only rotates.
    """

    rate: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """Radians per second."""
    acceleration: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """Radians per second squared."""
    parallax: Float[np.ndarray, "gh gw 2"] | None = None
    """Parallax, by the depth of each point: x/z and y/z per second at the cells of a grid that
    covers the image; None where unknown."""

    def angles(self, times: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Return the rotation vectors at times in seconds from the middle row."""
        t = times[:, None]
        return t * self.rate + 0.5 * t * t * self.acceleration

    @property
    def is_still(self) -> bool:
        """Whether it does not rotate at all."""
        return not (self.rate.any() or self.acceleration.any())


def rotated(
    vectors: Float[np.ndarray, "n 3"], by: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Rotate each vector by its own rotation vector, radians."""
    from geogs.camera.shutter.turning_kernels import turn

    turned = np.empty((len(vectors), 3))
    turn(np.ascontiguousarray(vectors), np.ascontiguousarray(by), turned)
    return turned


@dataclass(frozen=True)
class AngularStep:
    """Motion of the camera between two images of a video."""

    rate: Float[np.ndarray, "3"]
    """Mean angular velocity, radians per second."""
    interval: float
    """Seconds between the two."""
    parallax: tuple[Float[np.ndarray, "gh gw 2"], Float[np.ndarray, "gh gw 2"]] | None = None
    """Parallax, x/z and y/z per second, in the first image and the second."""


def angular_motion_between(before: AngularStep | None, after: AngularStep | None) -> AngularMotion:
    """Return the motion at an image from the steps to it and from it, either of which may be None.

    The mean rate is assumed for the middle of its step; between the two middles it is linear.
    """
    if before is None or after is None:
        known = before or after
        if known is None:
            return AngularMotion()
        return AngularMotion(
            known.rate, parallax=known.parallax and known.parallax[known is before]
        )
    between = (before.interval + after.interval) / 2
    fraction = before.interval / (2 * between)
    rate = before.rate + fraction * (after.rate - before.rate)
    parallax = None
    if before.parallax is not None and after.parallax is not None:
        parallax = _agreed(before.parallax[1], after.parallax[0], fraction)
    return AngularMotion(rate, (after.rate - before.rate) / between, parallax)


def _agreed(
    before: Float[np.ndarray, "gh gw 2"], after: Float[np.ndarray, "gh gw 2"], fraction: float
) -> Float[np.ndarray, "gh gw 2"]:
    """Mean of the two, shrunk the more they differ: flow that fails differs."""
    mean = before + fraction * (after - before)
    change = after - before
    square = (mean**2).sum(2, keepdims=True)
    error = (change**2).sum(2, keepdims=True)
    weight: Float[np.ndarray, "gh gw 1"] = square / np.maximum(square + error, 1e-12)
    return weight * mean
