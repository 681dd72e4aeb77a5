"""Upright orientation of a result: the same on its page, in its plots and in its exports."""

import numpy as np
from jaxtyping import Float

from geogs.evaluation.model_view.levelling import Level, facets, level
from geogs.mesh.triangle_mesh import Mesh
from geogs.types import Trajectory


def upright(trajectory: Trajectory, mesh: Mesh | None) -> Level:
    """Upright axes of a result, by its surface, if it has one, and its cameras."""
    surface = None if mesh is None else facets(mesh.vertices, mesh.faces, mesh.normals)
    return level(surface, tracked_poses(trajectory))


def tracked_poses(trajectory: Trajectory) -> Float[np.ndarray, "k 4 4"]:
    """Camera-to-world poses of the tracked frames, or of all where none is tracked."""
    tracked = trajectory.tracked
    return trajectory.T_wc[tracked] if tracked.any() else trajectory.T_wc
