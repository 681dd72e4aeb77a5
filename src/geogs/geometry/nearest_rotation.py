"""The rotation nearest to a matrix."""

import numpy as np
from jaxtyping import Float, Float64


def nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """The rotation R that makes ``trace(R^T matrix)`` largest (orthogonal Procrustes problem).

    For a sum of ``w b a^T`` it turns the directions a nearest to the directions b; for a sum of
    ``B A^T`` it turns the world of the orientations A nearest to that of B.
    """
    u, _, vt = np.linalg.svd(matrix)
    rotation: Float64[np.ndarray, "3 3"] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation
