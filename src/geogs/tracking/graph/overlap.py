"""Fast rejection of keyframe pairs that cannot be matched, without testing single cells."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.world.keyframes import KeyframeSet

TILES = 4, 6
"""Rows and columns of tiles into which the cells of a keyframe are grouped."""
LARGEST_ZOOM = 2.5
"""Largest ratio of the image scales at which two keyframes show the same point: matching compares
windows of one size. Two keyframes that face each other from rooms away, through all walls between,
would pass by motion alone, as each sees the other's view far ahead, where little moves."""
STEP = 2
"""Interval of the rows and columns of cells that are used, as for distances of keyframes."""
TARGETS_TOGETHER = 32
"""Keyframes against which all others are tested at a time; bounds memory."""


@dataclass(frozen=True)
class _Spheres:
    """Bounding spheres of the points seen by each tile of each keyframe, in world coordinates."""

    centre: Float[Tensor, "n t 3"]
    radius: Float[Tensor, "n t"]
    fraction: Float[Tensor, "t"]
    """Fraction of the cells in each tile."""

    def around(self) -> "_Spheres":
        """Return one sphere around all points of each keyframe."""
        centre = self.centre.mean(1, keepdim=True)
        reach = (self.centre - centre).norm(dim=-1) + self.radius
        return _Spheres(centre, 1.001 * reach.amax(1, keepdim=True), torch.ones(1))

    def of(self, rows: Int[Tensor, "m"]) -> "_Spheres":
        """Return the spheres of some of the keyframes."""
        return _Spheres(self.centre[rows], self.radius[rows], self.fraction)

    def reach(
        self, normal: Float[Tensor, "m k 3"], offset: Float[Tensor, "m k"]
    ) -> Bool[Tensor, "n m t"]:
        """Whether each sphere reaches into the frustum of each view."""
        distance = torch.einsum("ntd,mkd->nmtk", self.centre, normal) + offset[:, None]
        return (distance >= -self.radius[:, None, :, None]).all(-1)


def may_overlap(
    store: KeyframeSet, source: Sequence[int], target: Sequence[int], least: float
) -> Bool[np.ndarray, "n m"]:
    """Return False where at most a fraction ``least`` of a source's cells falls into a target.

    A tile whose bounding sphere reaches into the target's view counts with all its cells, so False
    is certain, but True is not.
    """
    spheres = _spheres(store, source)
    whole = spheres.around()
    out = np.full((len(source), len(target)), least <= 1e-6)
    for begin in range(0, len(target), TARGETS_TOGETHER):
        part = target[begin : begin + TARGETS_TOGETHER]
        planes = _view_planes(store.grid.camera, store.poses(part))
        # On a long walk most keyframes are nowhere near these few.
        near = torch.nonzero(whole.reach(*planes)[..., 0].any(1))[:, 0]
        fraction = spheres.of(near).reach(*planes).float() @ spheres.fraction
        out[near.numpy(), begin : begin + len(part)] = (fraction > least - 1e-6).numpy()
    return out


def alike_in_size(
    store: KeyframeSet, first: Sequence[int], second: Sequence[int]
) -> Bool[np.ndarray, "n m"]:
    """Whether the image scales of two keyframes differ by a ratio up to ``LARGEST_ZOOM``.

    They are compared at the point on the optical axis of each, at its median depth.
    """
    ids = sorted({*first, *second})
    row = {id: n for n, id in enumerate(ids)}
    T_wc = se3_inverse(store.poses(ids)).float()
    depth = torch.cat([
        1 / store.inverse_depths(ids[n : n + 64]).median(1).values.cpu()
        for n in range(0, len(ids), 64)
    ])  # fmt: skip
    centre, point = T_wc[:, :3, 3], T_wc[:, :3, 2] * depth[:, None] + T_wc[:, :3, 3]
    i, j = ([row[id] for id in part] for part in (first, second))

    def fits(seeing: list[int], other: list[int]) -> Bool[Tensor, "a b"]:
        zoom = torch.cdist(point[seeing], centre[other]) / depth[seeing, None]
        return (zoom <= LARGEST_ZOOM) & (zoom >= 1 / LARGEST_ZOOM)

    alike: Bool[np.ndarray, "n m"] = (fits(i, j) & fits(j, i).mT).numpy()
    return alike


def _spheres(store: KeyframeSet, ids: Sequence[int]) -> _Spheres:
    grid = store.grid
    rows, columns = torch.arange(0, grid.height, STEP), torch.arange(0, grid.width, STEP)
    tile = (rows * TILES[0] // grid.height)[:, None] * TILES[1] + columns * TILES[1] // grid.width
    cells = (rows[:, None] * grid.width + columns).reshape(-1)
    rays = grid.rays.cpu()[cells]
    groups = [torch.nonzero(tile.reshape(-1) == t)[:, 0] for t in tile.unique().tolist()]
    T_wc = se3_inverse(store.poses(ids)).float()
    centres, radii = [], []
    for begin in range(0, len(ids), 64):
        part = slice(begin, begin + 64)
        depth = 1 / store.inverse_depths(ids[part]).cpu()[:, cells, None]
        points = (rays * depth) @ T_wc[part, :3, :3].mT + T_wc[part, None, :3, 3]
        grouped = [points[:, g] for g in groups]
        middle = [(p.amin(1) + p.amax(1)) / 2 for p in grouped]
        far = [(p - c[:, None]).norm(dim=-1).amax(1) for p, c in zip(grouped, middle, strict=True)]
        centres.append(torch.stack(middle, 1))
        radii.append(torch.stack(far, 1))
    centre, radius = torch.cat(centres), torch.cat(radii)
    slack = 1e-5 * (centre.norm(dim=-1) + T_wc[:, :3, 3].norm(dim=-1).max())
    count = torch.tensor([len(g) for g in groups], dtype=torch.float32)
    return _Spheres(centre, 1.001 * radius + slack, count / len(cells))


def _view_planes(
    camera: Camera, T_cw: Float[Tensor, "m 4 4"]
) -> tuple[Float[Tensor, "m 5 3"], Float[Tensor, "m 5"]]:
    """Return inward normals n and offsets o of each view's frustum: n . x + o >= 0 within."""
    c = camera
    planes = torch.tensor(
        [
            [c.fx, 0, c.cx],
            [-c.fx, 0, c.width - 1 - c.cx],
            [0, c.fy, c.cy],
            [0, -c.fy, c.height - 1 - c.cy],
            [0, 0, 1],
        ],
        dtype=torch.float64,
    )
    planes = planes / planes.norm(dim=1, keepdim=True)
    normal = planes @ T_cw[:, :3, :3]
    offset = (planes @ T_cw[:, :3, 3:])[..., 0]
    return normal.float(), offset.float()
