"""The rotation nearest to a matrix."""

import numpy as np
from jaxtyping import Float, Float64


def nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation R that maximises ``trace(R^T matrix)`` (orthogonal Procrustes problem).

    For a sum of ``w b a^T`` it aligns the directions a with the directions b; for a sum of
    ``B A^T`` it aligns the world of the orientations A with that of B.
    """
    u, _, vt = np.linalg.svd(matrix)
    rotation: Float64[np.ndarray, "3 3"] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation
