"""Relative pose of two views from their flow alone, and the depth that it gives."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from geogs.bundle.projection import project
from geogs.geometry.camera import Camera
from geogs.threads import thread_map
from geogs.tracking.matching.pnp import pnp
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

FARTHEST = 50.0
"""Baselines beyond which a point says nothing on which of four poses is the right one."""
COMPARED = 5
"""Pairs of views that are compared by what other views say of their depths."""
AGREEING = 0.004
"""A cell agrees that lies no farther from where it was matched, of the long edge."""


@dataclass(frozen=True)
class TwoView:
    """The relative pose of a pair of views and the depth that it gives, up to scale; on the CPU."""

    T_ji: Float[Tensor, "4 4"]
    inverse_depth: Float[Tensor, "p"]
    """Inverse depth of the first view's cells, median 1; 1 where it is not good."""
    good: Bool[Tensor, "p"]
    parallax: float
    """Median motion in pixels that rotation does not explain."""


def best_two_view(
    camera: Camera, flows: Sequence[FlowMatch], min_parallax: float
) -> tuple[int, TwoView] | None:
    """The pair to start from, of the flows from one view to others; None without parallax.

    An essential matrix of a short baseline may be wrong and yet suit its pair well, so a few of
    the pairs that have parallax over most good cells are compared: the depth that most cells
    agree with, wherever they are matched, is right. Each cell has one vote: what is followed
    longest may be the car ahead.

    Args:
        camera: of all views.
        flows: from the first view to each other, on the CPU.
        min_parallax: motion that rotation does not explain, at least, pixels.

    Returns:
        The index of the pair among the flows, and what it gives.
    """
    found = thread_map(lambda match: two_view(camera, match), flows)
    able = [(n, v) for n, v in enumerate(found) if v is not None and v.parallax >= min_parallax]
    # Parallax helps until the views no longer overlap.
    able.sort(key=lambda c: -min(c[1].parallax, 3 * min_parallax) * int(c[1].good.sum()))
    able = able[:COMPARED]
    if len(able) < 2:
        return able[0] if able else None
    grid = SampleGrid(camera)
    pairs = [(view, match) for _, view in able for match in flows]
    agreeing = torch.stack(thread_map(lambda pair: agreement(grid, *pair), pairs))
    matched = torch.stack([match.sure()[0] for match in flows]).sum(0).clamp(min=1)
    support = (agreeing.reshape(len(able), len(flows), -1).sum(1) / matched).sum(1)
    return able[int(support.argmax())]


def agreement(grid: SampleGrid, view: TwoView, match: FlowMatch) -> Bool[Tensor, "p"]:
    """Which cells of a flow agree with the depth of a pair of views, wherever it leads to.

    The pose there is found from them (PnP). All on the CPU.
    """
    good = view.good & match.sure()[0]
    T = pnp(grid, view.inverse_depth, match.pixels[0], good)
    if T is None:
        return torch.zeros_like(good)
    at = project(grid.camera, grid.rays, T[None].float(), view.inverse_depth[None])
    near = (at.pixels[0] - match.pixels[0]).norm(dim=-1) < AGREEING * grid.camera.long_edge
    return good & near & at.valid[0]


def two_view(camera: Camera, match: FlowMatch) -> TwoView | None:
    """Relative pose by the essential matrix and depth by triangulation, on the CPU."""
    found = relative_pose(camera, match)
    if found is None:
        return None
    T, inliers = found
    p, q = SampleGrid(camera).pixels.double().numpy(), match.pixels[0].double().numpy()
    K, count = camera.matrix().numpy(), len(p)
    homogeneous = cv2.triangulatePoints(K @ np.eye(3, 4), K @ T[:3], p[inliers].T, q[inliers].T)
    z = homogeneous[2] / np.where(np.abs(homogeneous[3]) < 1e-12, 1e-12, homogeneous[3])
    median = np.median(z[z > 0])
    near = (z > 0.1 * median) & (z < 10 * median)
    z, inliers = z[near], inliers[near]
    rotated = rays_through(p[inliers], K) @ (K @ T[:3, :3]).T
    parallax = np.median(np.linalg.norm(q[inliers] - rotated[:, :2] / rotated[:, 2:], axis=1))
    T[:3, 3] /= median
    depth, known = torch.ones(count), torch.zeros(count, dtype=torch.bool)
    depth[inliers], known[inliers] = torch.from_numpy(median / z).float(), True
    return TwoView(torch.from_numpy(T), depth, known, float(parallax))


def relative_pose(
    camera: Camera, match: FlowMatch
) -> tuple[Float64[np.ndarray, "4 4"], Int[np.ndarray, "n"]] | None:
    """First camera to second by the essential matrix (MAGSAC), and the cells that agree with it.

    The translation is a unit. None where too few cells are matched, or lie before both cameras.
    """
    used = match.sure()[0].numpy()
    if used.sum() < 0.1 * len(used):
        return None
    p, q = SampleGrid(camera).pixels.double().numpy(), match.pixels[0].double().numpy()
    K = camera.matrix().numpy()
    try:
        E, mask = cv2.findEssentialMat(p[used], q[used], K, cv2.USAC_MAGSAC, 0.9999, 0.7)
    except cv2.error:  # OpenCV 5 fails an assertion where no sample gives a model
        return None
    if E is None or E.shape != (3, 3):
        return None
    agreeing = np.flatnonzero(used)[mask[:, 0] > 0]
    R, t, in_front = _pose_of(E, rays_through(p[agreeing], K), rays_through(q[agreeing], K))
    if in_front.sum() < 0.3 * used.sum():
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T, agreeing[in_front]


def rays_through(
    pixels: Float64[np.ndarray, "n 2"], K: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Rays of z = 1 through the pixels of a camera with the matrix K."""
    return np.c_[(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(pixels))]


def _pose_of(
    E: Float64[np.ndarray, "3 3"],
    first: Float64[np.ndarray, "n 3"],
    second: Float64[np.ndarray, "n 3"],
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"], Bool[np.ndarray, "n"]]:
    """The one of the four poses of an essential matrix that sees most points before both cameras.

    Returns the rotation, the unit translation (first camera to second) and which points lie there,
    nearer than ``FARTHEST`` baselines. From z R a + t = z' b for the rays a and b of a point its
    two depths follow by the cross products with b and with R a.
    """
    R1, R2, t = cv2.decomposeEssentialMat(E)
    t, best = t[:, 0], None
    for R in (R1, R2):
        rotated = first @ R.T
        across = np.cross(rotated, second)
        square = np.maximum((across**2).sum(1), 1e-30)
        z_first = -(np.cross(t, second) * across).sum(1) / square
        z_second = -(np.cross(t, rotated) * across).sum(1) / square
        for sign in (1.0, -1.0):
            z, other = sign * z_first, sign * z_second
            seen = (z > 0) & (z < FARTHEST) & (other > 0) & (other < FARTHEST)
            if best is None or seen.sum() > best[2].sum():
                best = R, sign * t, seen
    assert best is not None
    return best
