"""Motion and scenes that do not tell the focal length: seen in the flow, without any camera.

A camera that only rotates, or that looks at a plane, moves its image by a homography. A general
scene under translation does not.
"""

import math
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from jaxtyping import Float

from geogs.geometry.camera import Camera
from geogs.tracking.calibration.view_gatherer import on_cpu, with_focal
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

MAX_COST = 6.0
"""Mean cost of a match, in variances, above which no pinhole camera explains the flow."""
PLANAR_FRACTION = 0.9
"""Where one homography explains this fraction of the matches in all views, they show a plane."""
_TOLERANCE = 1 / 400
"""Deviation, of the long edge, from a homography that is still explained by it."""
_FIELDS_OF_VIEW = np.geomspace(25, 130, 15)


class Degeneracy(Enum):
    """Why the flow cannot tell the focal length."""

    BLANK = "no frame has enough texture"
    STILL = "the camera hardly moves"
    TURNING = "the camera only turns (no parallax)"
    PLANAR = "it shows a single plane"
    UNEXPLAINED = "no pinhole camera explains its motion"


@dataclass(frozen=True)
class HomographyFit:
    """How well homographies explain the flow from one view to others."""

    explained: float
    """Fraction of the matches, in the view that fits least."""
    parallax: float
    """Pixels of median motion that rotation leaves, in the view where that is most, at the field
    of view for which it is least."""


def degeneracy(camera: Camera, flows: list[FlowMatch], min_parallax: float) -> Degeneracy | None:
    """What is wrong with the flow from one view to others; None if nothing is.

    ``min_parallax`` is in pixels; of the camera only size, aspect and principal point count.
    """
    fit = fit_homographies(camera, flows)
    if fit is None:
        return Degeneracy.STILL
    if fit.parallax < min_parallax:
        return Degeneracy.TURNING
    return Degeneracy.PLANAR if fit.explained > PLANAR_FRACTION else None


def fit_homographies(camera: Camera, flows: list[FlowMatch]) -> HomographyFit | None:
    """A homography for each view (MAGSAC); None where no view has enough matches."""
    points = SampleGrid(camera).pixels.double().numpy()
    tolerance = max(camera.width, camera.height) * _TOLERANCE
    found, explained = [], []
    for match in map(on_cpu, flows):
        used = match.sure()[0].numpy()
        if used.sum() < 50:
            continue
        p, q = points[used], match.pixels[0].double().numpy()[used]
        H, _ = cv2.findHomography(p, q, cv2.USAC_MAGSAC, tolerance)
        if H is None or not np.linalg.det(H) > 0:
            continue
        error = np.linalg.norm(_moved(H, p) - q, axis=1)
        explained.append(float((error < tolerance).mean()))
        found.append((H, p, q))
    if not found:
        return None
    cameras = [_camera(camera, a) for a in _FIELDS_OF_VIEW]
    parallax = min(max(_unexplained(c, *view) for view in found) for c in cameras)
    return HomographyFit(min(explained), parallax)


def _camera(camera: Camera, degrees: float) -> Float[np.ndarray, "3 3"]:
    edge = max(camera.width, camera.height)
    return with_focal(camera, edge / 2 / math.tan(math.radians(degrees / 2))).matrix().numpy()


def _unexplained(
    K: Float[np.ndarray, "3 3"],
    H: Float[np.ndarray, "3 3"],
    p: Float[np.ndarray, "n 2"],
    q: Float[np.ndarray, "n 2"],
) -> float:
    """Median distance of matches from where the rotation nearest to a homography moves them."""
    U, _, Vt = np.linalg.svd(np.linalg.inv(K) @ H @ K)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return float(np.median(np.linalg.norm(_moved(K @ R @ np.linalg.inv(K), p) - q, axis=1)))


def _moved(H: Float[np.ndarray, "3 3"], p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    y = np.c_[p, np.ones(len(p))] @ H.T
    return y[:, :2] / np.where(np.abs(y[:, 2:]) < 1e-9, 1e-9, y[:, 2:])
