"""Relative pose of two views from their flow alone, and the resulting depth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from geogs.bundle.projection import project
from geogs.geometry.camera import Camera
from geogs.geometry.jumps import widened
from geogs.geometry.robust import cauchy_weight
from geogs.threads import thread_map
from geogs.tracking.matching.pnp import pnp
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

MAX_BASELINES = 50.0
"""Largest depth, in baselines, of a point that selects the right one of the four poses."""
MAX_PAIRS = 5
"""Most pairs of views whose depths are compared by the other views."""
MIN_LASTING = 2 / 3
"""Fraction of the views in which a cell is matched to count as tracked longest."""
LASTING_FRACTION = 0.05, 0.8
"""Smallest and largest fraction of the first matches tracked longest, for trying without them."""
MIN_SUPPORT_RATIO = 1.2
"""Least ratio of the others' support without and with them for them to count as moving objects. In
static streets and rooms it was 1.00 to 1.06, with trucks that had biased the pose 1.4 to 2."""


@dataclass(frozen=True)
class TwoView:
    """Relative pose of a pair of views and the resulting depth, up to scale; on the CPU."""

    T_ji: Float[Tensor, "4 4"]
    inverse_depth: Float[Tensor, "p"]
    """Inverse depth of the first view's cells, median 1; 1 where it is not good."""
    good: Bool[Tensor, "p"]
    parallax: float
    """Median motion in pixels not explained by rotation."""
    apart: Bool[Tensor, "p"]
    """Cells of the first view on moving objects, judged by the others."""


def best_two_view(
    camera: Camera, flows: Sequence[FlowMatch], min_parallax: float
) -> tuple[int, TwoView] | None:
    """Choose the best initial pair among flows from one view to others; None without parallax.

    An essential matrix of a short baseline may be wrong and yet fit its pair well. So a few of the
    pairs with parallax over most good cells are compared: the depth that most matched cells agree
    with in the other views is right.

    Cells tracked longest, such as a truck ahead, have most matches, and a camera that rotates with
    the truck explains it as far away, and nearly all the rest. So pairs without these cells are
    compared as well, and chosen where the rest agrees with them clearly more.

    Args:
        camera: of all views.
        flows: from the first view to each other, on the CPU.
        min_parallax: least motion not explained by rotation, pixels.

    Returns:
        The index of the pair among the flows, and its result.
    """
    grid = SampleGrid(camera)
    best = _best_of(grid, flows, _with_parallax(camera, flows, min_parallax))
    if len(flows) < 2 or not (lasting := followed_longest(grid, flows)).any():
        return best
    rest = _with_parallax(camera, [without(f, lasting) for f in flows], min_parallax)
    other = _best_of(grid, flows, [(n, replace(view, apart=lasting)) for n, view in rest])
    same = None if other is None else two_view(camera, flows[other[0]])
    if other is None or same is None:
        return best
    n, apart = other
    with_them, alone = (
        float(_support(grid, flows, n, view)[~lasting].sum()) for view in (same, apart)
    )
    return other if alone > MIN_SUPPORT_RATIO * with_them else best


def followed_longest(grid: SampleGrid, flows: Sequence[FlowMatch]) -> Bool[Tensor, "p"]:
    """Return cells of the first view, dilated by one, that are matched in most views; none if they
    are very few, or most of the first matches."""
    sure = torch.stack([match.sure()[0] for match in flows])
    lasting = (sure.float().mean(0) >= MIN_LASTING).view(grid.height, grid.width)
    lasting = widened(lasting, 1).view(-1)
    fraction = float((lasting & sure[0]).sum()) / max(int(sure[0].sum()), 1)
    least, most = LASTING_FRACTION
    return lasting & (least <= fraction <= most)


def without(match: FlowMatch, cells: Bool[Tensor, "p"]) -> FlowMatch:
    """Return a flow without the matches of some cells."""
    return replace(match, weight=match.weight * ~cells[:, None])


def _with_parallax(
    camera: Camera, flows: Sequence[FlowMatch], min_parallax: float
) -> list[tuple[int, TwoView]]:
    """Return the few pairs with parallax over most good cells, best first, with flow indices."""
    found = thread_map(lambda match: two_view(camera, match), flows)
    able = [(n, v) for n, v in enumerate(found) if v is not None and v.parallax >= min_parallax]
    # Parallax helps until the views no longer overlap.
    able.sort(key=lambda c: -min(c[1].parallax, 3 * min_parallax) * int(c[1].good.sum()))
    return able[:MAX_PAIRS]


def _best_of(
    grid: SampleGrid, flows: Sequence[FlowMatch], found: Sequence[tuple[int, TwoView]]
) -> tuple[int, TwoView] | None:
    """Return the pair that most cells agree with; None for none."""
    if len(found) < 2:
        return found[0] if found else None
    support = thread_map(lambda f: float(_support(grid, flows, *f).sum()), found)
    return found[int(np.argmax(support))]


def _support(
    grid: SampleGrid, flows: Sequence[FlowMatch], own: int, view: TwoView
) -> Float[Tensor, "p"]:
    """Return the mean agreement of each cell with the depth of a pair of views, over the other
    views in which it is matched."""
    others = [match for n, match in enumerate(flows) if n != own]
    agreeing = torch.stack([agreement(grid, view, match) for match in others]).sum(0)
    matched = torch.stack([match.sure()[0] for match in others]).sum(0).clamp(min=1)
    return agreeing / matched


def agreement(grid: SampleGrid, view: TwoView, match: FlowMatch) -> Float[Tensor, "p"]:
    """Return the agreement of a flow's cells with the depth of a pair of views, from 0 to 1: the
    Cauchy weight of the residual in its own deviations.

    The pose of the flow's view is estimated from them (PnP). All on the CPU.
    """
    good = view.good & match.sure()[0]
    T = pnp(grid, view.inverse_depth, match.pixels[0], good)
    if T is None:
        return torch.zeros(len(good))
    at = project(grid.camera, grid.rays, T[None].float(), view.inverse_depth[None])
    square = ((at.pixels[0] - match.pixels[0]).square() * match.weight[0]).mean(-1)
    return torch.where(good & at.valid[0], cauchy_weight(square), 0.0)


def two_view(camera: Camera, match: FlowMatch) -> TwoView | None:
    """Estimate relative pose by the essential matrix and depth by triangulation, on the CPU."""
    found = relative_pose(camera, match)
    if found is None:
        return None
    T, inliers = found
    p, q = _straight_pixels(camera, match)
    K = camera.matrix().numpy()
    count = len(p)
    homogeneous = cv2.triangulatePoints(K @ np.eye(3, 4), K @ T[:3], p[inliers].T, q[inliers].T)
    z = homogeneous[2] / np.where(np.abs(homogeneous[3]) < 1e-12, 1e-12, homogeneous[3])
    median = np.median(z[z > 0])
    near = (z > 0.1 * median) & (z < 10 * median)
    z = z[near]
    inliers = inliers[near]
    rotated = rays_through(p[inliers], K) @ (K @ T[:3, :3]).T
    parallax = np.median(np.linalg.norm(q[inliers] - rotated[:, :2] / rotated[:, 2:], axis=1))
    T[:3, 3] /= median
    depth = torch.ones(count)
    known = torch.zeros(count, dtype=torch.bool)
    depth[inliers] = torch.from_numpy(median / z).float()
    known[inliers] = True
    none = torch.zeros(count, dtype=torch.bool)
    return TwoView(torch.from_numpy(T), depth, known, float(parallax), apart=none)


def relative_pose(
    camera: Camera, match: FlowMatch
) -> tuple[Float64[np.ndarray, "4 4"], Int[np.ndarray, "n"]] | None:
    """Estimate first camera to second by the essential matrix (MAGSAC), and its inlier cells.

    The translation has length one. None where too few cells are matched, or are in front of both
    cameras.
    """
    used = match.sure()[0].numpy()
    if used.sum() < 0.1 * len(used):
        return None
    p, q = _straight_pixels(camera, match)
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
    T[:3, :3] = R
    T[:3, 3] = t
    return T, agreeing[in_front]


def as_pinhole(camera: Camera, match: FlowMatch) -> FlowMatch:
    """Return the matches that the same camera without distortion would find: at the pixels where it
    sees them, with variances by its magnification there."""
    if camera.is_pinhole:
        return match
    plane = camera.plane(match.pixels)
    xx, xy, yy = camera.bend_jacobian(plane)
    weight = match.weight * (xx * yy - xy * xy).abs()[..., None]
    return FlowMatch(camera.pinhole.pixels(plane), weight)


def _straight_pixels(
    camera: Camera, match: FlowMatch
) -> tuple[Float64[np.ndarray, "p 2"], Float64[np.ndarray, "p 2"]]:
    """Return pixels of the cells and of their matches without distortion."""
    both = SampleGrid(camera).pixels, match.pixels[0]
    first, second = (camera.as_pinhole(pixels.double()).numpy() for pixels in both)
    return first, second


def rays_through(
    pixels: Float64[np.ndarray, "n 2"], K: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Return rays with z = 1 through the pixels of a camera with the matrix K."""
    return np.c_[(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(pixels))]


def _pose_of(
    E: Float64[np.ndarray, "3 3"],
    first: Float64[np.ndarray, "n 3"],
    second: Float64[np.ndarray, "n 3"],
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"], Bool[np.ndarray, "n"]]:
    """Choose the pose of an essential matrix, of four, with most points in front of both cameras.

    Returns the rotation, the unit translation (first camera to second) and which points are there,
    nearer than ``MAX_BASELINES``. From z R a + t = z' b for the rays a and b of a point its two
    depths follow by the cross products with b and with R a.
    """
    R1, R2, t = cv2.decomposeEssentialMat(E)
    t = t[:, 0]
    best = None
    for R in (R1, R2):
        rotated = first @ R.T
        across = np.cross(rotated, second)
        square = np.maximum((across**2).sum(1), 1e-30)
        z_first = -(np.cross(t, second) * across).sum(1) / square
        z_second = -(np.cross(t, rotated) * across).sum(1) / square
        for sign in (1.0, -1.0):
            z = sign * z_first
            other = sign * z_second
            seen = (z > 0) & (z < MAX_BASELINES) & (other > 0) & (other < MAX_BASELINES)
            if best is None or seen.sum() > best[2].sum():
                best = R, sign * t, seen
    assert best is not None
    return best
