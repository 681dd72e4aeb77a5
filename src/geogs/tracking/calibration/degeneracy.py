"""Motion and scenes that do not tell the focal length: seen in the flow, without any camera.

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
0.75 where the lens comes out right, people over a third of what is seen or not, of which the mean
tells nothing (docs/notebook/calibration.md)."""
PLANAR_FRACTION = 0.9
"""Where one homography explains this fraction of the matches in all views, they show a plane."""
_TOLERANCE = 1 / 1000
"""Deviation, of the long edge, from a homography that is still explained by it."""
_FIELDS_OF_VIEW = 25.0, 130.0
"""Degrees along the longer side, between which a rotation is looked for."""


class Degeneracy(Enum):
    """Why the flow cannot tell the focal length."""

    BLANK = "no frame has enough texture"
    STILL = "the camera hardly moves"
    TURNING = "the camera only turns (no parallax)"
    PLANAR = "it shows a single plane"
    UNEXPLAINED = "no pinhole camera explains its motion"


@dataclass(frozen=True)
class _HomographyFit:
    """The homography that explains the flow from one view to another best."""

    H: Float[np.ndarray, "3 3"]
    explained: float
    """Fraction of the matches."""
    first: Float[np.ndarray, "n 2"]
    """Pixels of the matches."""
    second: Float[np.ndarray, "n 2"]


def degeneracy(camera: Camera, flows: list[FlowMatch], min_parallax: float) -> Degeneracy | None:
    """What is wrong with the flow from one view to others; None if nothing is.

    A rotation that only one focal length explains tells it, however little else there is.
    ``min_parallax`` is in pixels; of the camera only size, aspect and principal point count.
    """
    fits = [fit for fit in (_homography(camera, match) for match in flows) if fit is not None]
    if not fits:
        return Degeneracy.STILL
    if min(fit.explained for fit in fits) <= PLANAR_FRACTION:
        return None

    def left(angle: float) -> float:
        """What rotation leaves, in the view where that is most, in pixels."""
        K = camera.with_field_of_view(angle).matrix().numpy()
        return max(_unexplained(K, fit) for fit in fits)

    if left(_FIELDS_OF_VIEW[0]) < min_parallax:
        return Degeneracy.TURNING
    least = minimize_scalar(left, bounds=_FIELDS_OF_VIEW, method="bounded").fun
    return None if least < min_parallax else Degeneracy.PLANAR


def _homography(camera: Camera, match: FlowMatch) -> _HomographyFit | None:
    """The homography of one view (MAGSAC); None where it has too few matches."""
    match, tolerance = match.on_cpu(), camera.long_edge * _TOLERANCE
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
    """Median distance of matches from where the rotation nearest to a homography moves them."""
    R = nearest_rotation(np.linalg.inv(K) @ fit.H @ K)
    moved = _moved(K @ R @ np.linalg.inv(K), fit.first)
    return float(np.median(np.linalg.norm(moved - fit.second, axis=1)))


def _moved(H: Float[np.ndarray, "3 3"], p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    y = np.c_[p, np.ones(len(p))] @ H.T
    return y[:, :2] / np.where(np.abs(y[:, 2:]) < 1e-9, 1e-9, y[:, 2:])
