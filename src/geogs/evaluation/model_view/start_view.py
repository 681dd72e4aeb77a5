"""Start view of a model: all of it is in the picture, and most of it faces the viewer."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from geogs.evaluation.held_camera import look_at_one_place
from geogs.evaluation.model_view.levelling import Facets

FIELD = 45.0
"""Vertical field of view, degrees."""
ASPECT = 1.5
"""Aspect ratio (width / height) that the model fits into; narrower ones need more distance."""
ELEVATION = 40.0
"""Elevation angle of the view, degrees."""
_TURNS = 24
"""Number of tested azimuths."""
_MARGIN = 1.05


class StartView(NamedTuple):
    """A camera that looks at a point, in the frame of the map."""

    eye: Float[np.ndarray, "3"]
    target: Float[np.ndarray, "3"]


def start_view(
    points: Float[np.ndarray, "n 3"],
    axes: Float[np.ndarray, "3 3"],
    T_wc: Float[np.ndarray, "k 4 4"],
    surface: Facets | None = None,
) -> StartView:
    """Choose an oblique view from above from which most of the surface faces the eye, so that the
    nearest walls are seen from behind; an object is seen from the side of the cameras.

    Args:
        points: points of its shape; all but far outliers are in the picture.
        axes: rows right, forward and up of the world.
        T_wc: the cameras, which are in the picture, too.
        surface: surface for the choice of the side; without it, the view is along the cameras'.
    """
    local = points.astype(np.float64) @ axes.T
    low, high = np.quantile(local, [0.005, 0.995], axis=0)
    is_near = ((local >= low) & (local <= high)).all(1)
    local = np.concatenate([local[is_near], T_wc[:, :3, 3] @ axes.T])
    middle = (local.min(0) + local.max(0)) / 2
    if look_at_one_place(T_wc):
        side = axes @ T_wc[0, :3, 3] - middle
        direction = np.array([*side[:2], max(side[2], 0.35 * np.linalg.norm(side[:2]))])
        direction /= max(np.linalg.norm(direction), 1e-12)
    else:
        direction = _open_side(axes, T_wc, surface)
    eye, target = _fitted(local, direction)
    return StartView(axes.T @ eye, axes.T @ target)


def _open_side(
    axes: Float[np.ndarray, "3 3"], T_wc: Float[np.ndarray, "k 4 4"], surface: Facets | None
) -> Float[np.ndarray, "3"]:
    """The direction, in level axes, from which most (foreshortened) area faces the viewer."""
    rise = np.radians(ELEVATION)
    turns = 2 * np.pi * (np.arange(_TURNS) + 0.5) / _TURNS
    level = np.stack([np.cos(turns), np.sin(turns)], 1) * np.cos(rise)
    tried = np.column_stack([level, np.full(_TURNS, np.sin(rise))])
    if surface is None:
        faced = tried @ (axes @ -T_wc[:, :3, 2].mean(0))
    else:
        local = surface.normals @ axes.T
        faced = np.array([surface.areas @ np.maximum(local @ d, 0) for d in tried])
    return np.asarray(tried[int(faced.argmax())])


def _fitted(
    local: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The nearest eye in this direction that sees all points, and the target at their centre.

    With z towards the eye and t = tan(field / 2), planes through the picture's edges touch points
    where x_eye + t z_eye = a = max(x + t z) and -x_eye + t z_eye = b = max(-x + t z), so that
    x_eye = (a - b) / 2 and z_eye = (a + b) / 2 t; the same for y, and the greater z is used.
    """
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= max(np.linalg.norm(right), 1e-12)
    frame = np.stack([right, np.cross(direction, right), direction])
    seen = local @ frame.T
    t = np.tan(np.radians(FIELD / 2)) * np.array([ASPECT, 1.0])
    a, b = ((sign * seen[:, :2] + t * seen[:, 2:]).max(0) for sign in (1, -1))
    middle = (seen[:, 2].min() + seen[:, 2].max()) / 2
    away = max(float(((a + b) / (2 * t)).max() - middle), 1e-6)
    target = np.array([*(a - b) / 2, middle]) @ frame
    return target + _MARGIN * away * direction, target
