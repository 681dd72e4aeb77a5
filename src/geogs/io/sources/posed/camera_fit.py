"""Estimation of a camera from matches between images whose poses are known.

The epipolar constraint of a match depends on the poses and on the rays of its two pixels. With the
poses given, the focal length, the aspect of the pixels and the radial distortion are those whose
rays meet it best (the Sampson distance, Hartley and Zisserman, eq. 11.9, with Cauchy's weight).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from geogs.geometry.camera import Camera
from geogs.geometry.epipolar import in_front_of_both
from geogs.io.sources.posed.matching import MatchedPair

FIELDS_OF_VIEW = (20.0, 140.0)
"""Narrowest and widest field of view along the longer side that a search tries, degrees."""
_TRIED = 40
_ROUNDS = 12
_STEPS = np.array([1e-4, 1e-4, 1e-4, 1e-4])
"""Steps of the numeric derivative by each parameter."""
_NOISE = 0.5
"""Least scale of Cauchy's weight, pixels."""
_LEAST_TRANSLATION = 1e-12


@dataclass(frozen=True, slots=True)
class Lens:
    """A pinhole with radial distortion: ray = plane (1 + k1 r^2 + k2 r^4), about the centre."""

    focal: float
    """fx, pixels."""
    aspect: float = 1.0
    """fy / fx."""
    k1: float = 0.0
    """Taken from distorted to straight, unlike OpenCV's coefficients: it has no inverse to find."""
    k2: float = 0.0

    def changed(self, by: Float64[np.ndarray, "4"]) -> "Lens":
        """The lens with changes of log focal, log aspect, k1 and k2 added."""
        focal, aspect = self.focal * np.exp(by[0]), self.aspect * np.exp(by[1])
        return Lens(float(focal), float(aspect), self.k1 + float(by[2]), self.k2 + float(by[3]))

    def rays(self, pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
        """Rays (x, y, 1) of pixels that count from the principal point."""
        plane = pixels / (self.focal, self.focal * self.aspect)
        r2 = (plane**2).sum(axis=1, keepdims=True)
        straight = plane * (1 + r2 * (self.k1 + r2 * self.k2))
        return np.concatenate([straight, np.ones((len(plane), 1))], axis=1)


@dataclass(frozen=True, slots=True)
class Matches:
    """Matches of all pairs, one below the other."""

    first: Float64[np.ndarray, "n 2"]
    """Pixels of the first image, counted from the principal point."""
    second: Float64[np.ndarray, "n 2"]
    pair: Int64[np.ndarray, "n"]
    """Pair of each match."""
    images: Int64[np.ndarray, "p 2"]
    """Images of each pair."""
    reach: float
    """Distance of the image's corner from the principal point, pixels."""

    @property
    def is_rim(self) -> Bool[np.ndarray, "n"]:
        """Whether either pixel is in the outer part of the image."""
        radii = [np.linalg.norm(p, axis=1) for p in (self.first, self.second)]
        return np.maximum(*radii) > 0.6 * self.reach

    def relative(self, T_cw: Float64[np.ndarray, "m 4 4"]) -> Float64[np.ndarray, "p 4 4"]:
        """From the first camera of each pair to the second."""
        return T_cw[self.images[:, 1]] @ np.linalg.inv(T_cw[self.images[:, 0]])

    def errors(self, T: Float64[np.ndarray, "p 4 4"], lens: Lens) -> Float64[np.ndarray, "n"]:
        """Signed Sampson distances in pixels, for the relative poses of the pairs."""
        one, two = lens.rays(self.first), lens.rays(self.second)
        E = _essential(T)[self.pair]
        line_two = np.einsum("nij,nj->ni", E, one)
        line_one = np.einsum("nij,ni->nj", E, two)
        slope = (line_two[:, :2] ** 2).sum(axis=1) + (line_one[:, :2] ** 2).sum(axis=1)
        return lens.focal * (two * line_two).sum(axis=1) / np.sqrt(slope.clip(1e-24))

    def in_front(self, T: Float64[np.ndarray, "p 4 4"], lens: Lens) -> Bool[np.ndarray, "n"]:
        """Whether the rays of each match meet in front of both cameras."""
        one, two = lens.rays(self.first), lens.rays(self.second)
        found = np.zeros(len(one), dtype=bool)
        for k in range(len(T)):
            here = self.pair == k
            found[here] = in_front_of_both(T[k], one[here], two[here])
        return found


def stacked(pairs: Sequence[MatchedPair], camera: Camera) -> Matches:
    """The matches of all pairs, in pixels of ``camera``."""
    centre = np.array([camera.cx, camera.cy])
    corners = np.array([[0, 0], [camera.width - 1, camera.height - 1]]) - centre
    counts = [len(pair.pixels_first) for pair in pairs]
    return Matches(
        np.concatenate([pair.pixels_first for pair in pairs]) - centre,
        np.concatenate([pair.pixels_second for pair in pairs]) - centre,
        np.repeat(np.arange(len(pairs)), counts),
        np.array([(pair.first, pair.second) for pair in pairs], dtype=np.int64),
        float(np.linalg.norm(np.abs(corners).max(axis=0))),
    )


@dataclass(frozen=True, slots=True)
class FittedLens:
    """A lens with its uncertainty."""

    lens: Lens
    deviations: Float64[np.ndarray, "4"]
    """Standard deviations of log focal, log aspect, k1 and k2; 0 where fixed. Matches of a pair
    err together, by its poses: pairs are what is independent."""


def fitted(
    matches: Matches, T: Float64[np.ndarray, "p 4 4"], start: Lens, free: Sequence[int]
) -> FittedLens:
    """The lens near ``start`` that explains the matches best, by Gauss-Newton.

    Args:
        matches: of at least a few pairs.
        T: relative poses of the pairs.
        start: first estimate.
        free: which of log focal, log aspect, k1 and k2 are estimated.
    """
    columns = list(free)
    lens = start
    for _ in range(_ROUNDS):
        H, gradients = _normal_equations(matches, T, lens, columns)
        step = np.zeros(4)
        step[columns] = np.linalg.solve(H, -gradients.sum(axis=0)).clip(-0.3, 0.3)
        lens = lens.changed(step)
        if np.abs(step).max() < 1e-6:
            break
    H, gradients = _normal_equations(matches, T, lens, columns)
    inverse = np.linalg.inv(H)
    count = max(len(gradients), 2)
    covariance = inverse @ (gradients.T @ gradients) @ inverse * count / (count - 1)
    deviations = np.zeros(4)
    deviations[columns] = np.sqrt(np.diagonal(covariance))
    return FittedLens(lens, deviations)


def searched(matches: Matches, T: Float64[np.ndarray, "p 4 4"], aspect: float = 1.0) -> FittedLens:
    """The focal length that explains the matches best, of any field of view."""
    half = np.radians(np.linspace(*FIELDS_OF_VIEW, _TRIED)) / 2
    tried = [Lens(float(matches.reach * 0.8 / np.tan(angle)), aspect) for angle in half]
    costs = [np.median(np.abs(matches.errors(T, lens))) for lens in tried]
    return fitted(matches, T, tried[int(np.argmin(costs))], (0,))


def _normal_equations(
    matches: Matches, T: Float64[np.ndarray, "p 4 4"], lens: Lens, columns: list[int]
) -> tuple[Float64[np.ndarray, "k k"], Float64[np.ndarray, "p k"]]:
    """Approximate Hessian, damped a little, and the gradient of each pair."""
    errors = matches.errors(T, lens)
    J = np.empty((len(errors), len(columns)))
    for k, column in enumerate(columns):
        step = np.zeros(4)
        step[column] = _STEPS[column]
        ahead, behind = (matches.errors(T, lens.changed(s)) for s in (step, -step))
        J[:, k] = (ahead - behind) / (2 * _STEPS[column])
    scale = max(_NOISE, 2 * float(np.median(np.abs(errors))))
    weighted = J / (1 + (errors / scale) ** 2)[:, None]
    gradients = np.zeros((len(T), len(columns)))
    np.add.at(gradients, matches.pair, weighted * errors[:, None])
    return weighted.T @ J + 1e-9 * np.eye(len(columns)), gradients


def _essential(T: Float64[np.ndarray, "p 4 4"]) -> Float64[np.ndarray, "p 3 3"]:
    """Essential matrices for translations of length 1."""
    t = T[:, :3, 3]
    length = np.linalg.norm(t, axis=1, keepdims=True)
    x, y, z = (t / length.clip(_LEAST_TRANSLATION)).T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    return cross @ T[:, :3, :3]
