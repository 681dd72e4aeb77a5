"""Distances of matches from the epipolar geometry of two views with known poses."""

import numpy as np
from jaxtyping import Bool, Float64


def epipolar_distance(
    T: Float64[np.ndarray, "4 4"],
    K_inverse: Float64[np.ndarray, "3 3"],
    one: Float64[np.ndarray, "n 3"],
    two: Float64[np.ndarray, "n 3"],
) -> Float64[np.ndarray, "n"]:
    """Return Sampson's first-order distance to x2^T F x1 = 0 (Hartley and Zisserman, eq. 11.9).

    Without translation between the views: the distance from x1 moved by the rotation.

    Args:
        T: from the first camera to the second.
        K_inverse: from points (x, y, 1) of both to rays; the identity where they are rays.
        one: points of the first view.
        two: their matches in the second, in whose unit the distance is.
    """
    t = T[:3, 3]
    length = np.linalg.norm(t)
    if length < 1e-12:
        moved = one @ (np.linalg.inv(K_inverse) @ T[:3, :3] @ K_inverse).T
        return np.linalg.norm(moved[:, :2] / moved[:, 2:] - two[:, :2], axis=1)
    cross = np.cross(np.eye(3), t / length)
    F = K_inverse.T @ -cross @ T[:3, :3] @ K_inverse
    line_two = one @ F.T
    line_one = two @ F
    value = (two * line_two).sum(axis=1)
    slope = (line_two[:, :2] ** 2).sum(axis=1) + (line_one[:, :2] ** 2).sum(axis=1)
    return np.abs(value) / np.sqrt(slope.clip(1e-24))


def in_front_of_both(
    T: Float64[np.ndarray, "4 4"],
    one: Float64[np.ndarray, "n 3"],
    two: Float64[np.ndarray, "n 3"],
    parallel: float = 0.0,
) -> Bool[np.ndarray, "n"]:
    """Whether rays come nearest to each other in front of both cameras (cheirality).

    The epipolar geometry does not change if a camera is rotated by half a turn about the baseline
    (Hartley and Zisserman, 9.6.3).

    Args:
        T: from the first camera to the second.
        one: rays of the first view.
        two: their matches in the second.
        parallel: angle, radians, below which rays count as parallel: their point is far away.
    """
    a, b = one @ T[:3, :3].T, two
    aa, bb, ab = ((x * y).sum(axis=1) for x, y in ((a, a), (b, b), (a, b)))
    at = a @ T[:3, 3]
    bt = b @ T[:3, 3]
    in_front = (ab * bt > bb * at) & (aa * bt > ab * at)
    return in_front | (ab > np.cos(parallel) * np.sqrt(aa * bb))


def homogeneous(points: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    """Return (x, y, 1)."""
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)
