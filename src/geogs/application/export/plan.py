"""Floor plans and sections of a result."""

from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from geogs.errors import InputError
from geogs.evaluation.model_view.shown_model import Lengths
from geogs.io.writers.exports.line_drawing import LineDrawing
from geogs.mesh.drawing.cut import cut_mesh, heights
from geogs.mesh.drawing.walls import find_walls
from geogs.mesh.triangle_mesh import Mesh

PLAN_HEIGHT = 1.2
"""Height of a plan's cut over the floor, metres: through doors and most windows."""


def draw_cut(
    mesh: Mesh,
    kind: Literal["plan", "section"],
    at: float | None,
    unit: Lengths,
    cameras: Float[np.ndarray, "k 3"],
) -> LineDrawing:
    """Draw a cut through a mesh whose axes are right, forward and up.

    Args:
        mesh: the surface, map units.
        kind: a plan is cut at a height; a section is vertical, and looks forward.
        at: height over the floor, or distance in front of the middle of the cameras, in the unit of
            the drawing. By default 1.2 m or, where metres are not known, a third of the height; and
            0.
        unit: unit of the map; the drawing is in metres where these are known.
        cameras: positions of the cameras, map units.

    Raises:
        InputError: the plane meets no surface.
    """
    factor = unit.metres or 1.0
    mesh = replace(mesh, vertices=np.float32(factor) * mesh.vertices)
    low, high = heights(mesh)
    if kind == "plan":
        height = PLAN_HEIGHT if unit.metres is not None else (high - low) / 3
        height = height if at is None else at
        cut = cut_mesh(mesh, 2, low + height)
        where = f"{height:.3g} above the floor"
    else:
        place = factor * float(np.median(cameras[:, 1])) + (at or 0.0)
        cut = cut_mesh(mesh, 1, place)
        where = f"{at or 0.0:.3g} in front of the middle of the path"
    if not len(cut.ends):
        raise InputError(
            f"There is no surface {where}; the floor is at {low:.3g}, the top at {high:.3g}: "
            "give another place by --cut."
        )
    walls = find_walls(cut)
    name = "map units" if unit.metres is None else "m"
    title = f"{kind.capitalize()}, {where.replace(' ', ' m ' if name == 'm' else ' ', 1)}"
    return LineDrawing(title, walls.ends, walls.inward, walls.others.ends, name)
