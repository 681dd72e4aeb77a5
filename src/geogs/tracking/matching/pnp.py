"""Pose of a view from cells or features of known depth (PnP)."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.tracking.matching.sparse_features import FeatureMatches
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe

MIN_POINTS = 50, 25
"""Fewest cells, and fewest features, for a pose."""


def pnp(
    grid: SampleGrid,
    inverse_depth: Float[Tensor, "p"],
    pixels: Float[Tensor, "p 2"],
    good: Bool[Tensor, "p"],
) -> Float[Tensor, "4 4"] | None:
    """Estimate the pose T_ji of a view from cells with depth and their positions in it."""
    points = grid.rays[good] / inverse_depth[good, None]
    return _pnp(grid.camera, points, pixels[good], MIN_POINTS[0])


def pnp_features(
    grid: SampleGrid, keyframe: Keyframe, matches: FeatureMatches
) -> Float[Tensor, "4 4"] | None:
    """Estimate the pose T_ji of a view from features of a keyframe, with depths of their cells."""
    cell, inside = grid.cells_of(matches.first.to(grid.device))
    known = inside & (keyframe.information[cell] > 0)
    plane = grid.camera.plane(matches.first.to(grid.device))
    rays = torch.cat([plane, torch.ones_like(plane[:, :1])], -1)
    points = (rays / keyframe.inverse_depth[cell, None])[known]
    return _pnp(grid.camera, points, matches.second.to(grid.device)[known], MIN_POINTS[1])


def _pnp(
    camera: Camera, points: Float[Tensor, "n 3"], pixels: Float[Tensor, "n 2"], least: int
) -> Float[Tensor, "4 4"] | None:
    """Estimate the pose of a view from at least ``least`` points and pixels (RANSAC, SQPnP)."""
    if len(points) < least:
        return None
    ok, rotation, translation, inliers = cv2.solvePnPRansac(
        points.double().cpu().numpy(),
        camera.as_pinhole(pixels.double().cpu()).numpy(),
        camera.matrix().numpy(),
        None,
        iterationsCount=200,
        reprojectionError=camera.long_edge / 250,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not ok or inliers is None or len(inliers) < 0.3 * len(points):
        return None
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rotation)[0]
    T[:3, 3] = translation[:, 0]
    return torch.from_numpy(T) if np.isfinite(T).all() else None
