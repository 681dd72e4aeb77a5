"""Votes of the views on points: on a surface, or in free space."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32

from geogs.depth.depth_view import KeyframeDepth
from geogs.depth.reprojection_kernels import relative_depths
from geogs.geometry.camera import Camera

VOTE_CONFIDENCE = 0.5
"""Confidence above which pixels vote on points."""
VOTE_SUPPORT = 0.04
"""Relative distance from a depth within which a point lies on the surface."""
VOTE_VIOLATION = 0.08
"""Relative distance in front of a depth beyond which a point lies in free space: twice that of the
support, so that points in between get no vote."""
VOTE_FREE_VIEWS = 2
"""Fewest views in whose free space a removed point lies: one may be wrong."""


def look_up(
    points: Float32[np.ndarray, "n 3"],
    T_view: Float64[np.ndarray, "4 4"],
    depth: KeyframeDepth,
    camera: Camera,
) -> tuple[Float32[np.ndarray, "n"], Float32[np.ndarray, "n"]]:
    """Ratio of each point's z to the view's depth there, and its confidence; 0, 0 where unseen.

    ``T_view`` takes the frame of the points to the view's camera. Finite input only.
    """
    ratio = np.empty(len(points), np.float32)
    confidence = np.empty(len(points), np.float32)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    rotation = np.ascontiguousarray(T_view[:3, :3], np.float32)
    translation = np.ascontiguousarray(T_view[:3, 3], np.float32)
    relative_depths(
        points, rotation, translation, lens, depth.depth, depth.confidence, ratio, confidence
    )
    return ratio, confidence


def count_votes(
    points: Float[np.ndarray, "n 3"],
    views: Iterable[tuple[Float64[np.ndarray, "4 4"], KeyframeDepth]],
    camera: Camera,
) -> tuple[Int32[np.ndarray, "n"], Int32[np.ndarray, "n"]]:
    """Number of views that see each world point on their surface, and in their free space.

    A view is its world-to-camera pose and its depth. Pixels with confidence above
    ``VOTE_CONFIDENCE`` vote: for the surface within ``VOTE_SUPPORT`` of their depth, for free space
    if the point is more than ``VOTE_VIOLATION`` in front of it (both relative).
    """
    points = np.ascontiguousarray(points, np.float32)
    surface = np.zeros(len(points), np.int32)
    free = np.zeros(len(points), np.int32)
    for pose, depth in views:
        ratio, confidence = look_up(points, pose, depth, camera)
        votes = confidence > VOTE_CONFIDENCE
        surface += votes & (np.abs(ratio - 1.0) < VOTE_SUPPORT)
        free += votes & (ratio < 1.0 - VOTE_VIOLATION)
    return surface, free


def vote(
    points: Float[np.ndarray, "n 3"],
    views: Iterable[tuple[Float64[np.ndarray, "4 4"], KeyframeDepth]],
    camera: Camera,
) -> Bool[np.ndarray, "n"]:
    """Whether to keep world points: the finite ones, except those that at least ``VOTE_FREE_VIEWS``
    views, and more views than support them, see in free space.
    """
    finite = np.isfinite(points).all(1)
    surface, free = count_votes(points[finite], views, camera)
    keep = np.zeros(len(points), bool)
    keep[finite] = (free < VOTE_FREE_VIEWS) | (free <= surface)
    return keep
