"""Detection of motions and scenes that do not determine the focal length, from flow alone.

A camera that only rotates, or that looks at a plane, moves its image by a homography. A general
scene under translation does not.
"""

from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from geogs.geometry.camera import Camera
from geogs.geometry.nearest_rotation import nearest_rotation
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

MAX_COST = 1.5
"""Mean cost of a match, in variances, above which no lens explains the flow from one view: 0.1 to
1.0 where it is about right (docs/notebook/calibration.md)."""
MAX_RESIDUAL = 1.0
"""Median residual of a match, in its deviations, above which no camera explains all pairs: 0.3 to
0.75 where the estimated lens is right, even with people over a third of the view, for which the
mean fails (docs/notebook/calibration.md)."""
PLANAR_FRACTION = 0.9
"""Fraction of the matches, in all views, explained by a homography, above which a plane is seen."""
_FIELDS_OF_VIEW = 25.0, 130.0
"""Search range of the field of view of a rotating camera, degrees along the longer side."""


class Degeneracy(Enum):
    """Reasons why the flow does not determine the focal length."""

    BLANK = "no frame has enough texture"
    STILL = "the camera hardly moves"
    TURNING = "the camera only turns (no parallax)"
    PLANAR = "it shows a single plane"
    UNEXPLAINED = "no pinhole camera explains its motion"


@dataclass(frozen=True)
class _HomographyFit:
    """Homography that fits the flow from one view to another best."""

    H: Float[np.ndarray, "3 3"]
    explained: float
    """Fraction of the matches that it explains."""
    first: Float[np.ndarray, "n 2"]
    """Pixels of the matches."""
    second: Float[np.ndarray, "n 2"]


def degeneracy(camera: Camera, flows: list[FlowMatch], min_parallax: float) -> Degeneracy | None:
    """Detect a degeneracy of the flow from one view to others; None if there is none.

    A rotation that only one focal length explains determines it, even without parallax.
    ``min_parallax`` is in pixels; of the camera only size, aspect and principal point are used.
    """
    fits = [fit for fit in (_homography(camera, match) for match in flows) if fit is not None]
    if not fits:
        return Degeneracy.STILL
    if min(fit.explained for fit in fits) <= PLANAR_FRACTION:
        return None

    def residual(angle: float) -> float:
        """Return the largest residual of a rotation over the views, in pixels."""
        K = camera.with_field_of_view(angle).matrix().numpy()
        return max(_unexplained(K, fit) for fit in fits)

    if residual(_FIELDS_OF_VIEW[0]) < min_parallax:
        return Degeneracy.TURNING
    least = minimize_scalar(residual, bounds=_FIELDS_OF_VIEW, method="bounded").fun
    return None if least < min_parallax else Degeneracy.PLANAR


def _homography(camera: Camera, match: FlowMatch) -> _HomographyFit | None:
    """Fit the homography of one view (MAGSAC); None where it has too few matches."""
    match = match.on_cpu()
    tolerance = 1 / 1000 * camera.long_edge  # pixels of deviation from a homography
    used = match.sure()[0].numpy()
    if used.sum() < 50:
        return None
    p = SampleGrid(camera).pixels.double().numpy()[used]
    q = match.pixels[0].double().numpy()[used]
    H, _ = cv2.findHomography(p, q, cv2.USAC_MAGSAC, tolerance)
    if H is None or not np.linalg.det(H) > 0:
        return None
    error = np.linalg.norm(_moved(H, p) - q, axis=1)
    return _HomographyFit(H, float((error < tolerance).mean()), p, q)


def _unexplained(K: Float[np.ndarray, "3 3"], fit: _HomographyFit) -> float:
    """Return the median residual of matches for the rotation nearest to a homography."""
    R = nearest_rotation(np.linalg.inv(K) @ fit.H @ K)
    moved = _moved(K @ R @ np.linalg.inv(K), fit.first)
    return float(np.median(np.linalg.norm(moved - fit.second, axis=1)))


def _moved(H: Float[np.ndarray, "3 3"], p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    y = np.c_[p, np.ones(len(p))] @ H.T
    return y[:, :2] / np.where(np.abs(y[:, 2:]) < 1e-9, 1e-9, y[:, 2:])
