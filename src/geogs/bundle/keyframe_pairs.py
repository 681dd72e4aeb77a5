"""Directed pairs of keyframes on the CPU: projections of cells, and distances."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.projection import project
from geogs.world.keyframes import KeyframeSet

LEAST_OVERLAP = 0.2
"""Fraction of the cells that fall into the other image at or below which a pair is far."""

CELL_STEP = 2
"""Interval of the rows and columns of cells used for a distance."""


class KeyframePairs:
    """Directed pairs (source, target) of keyframes, by their present poses and inverse depths."""

    def __init__(self, keyframes: KeyframeSet, directed: Sequence[tuple[int, int]]) -> None:
        self.grid = keyframes.grid
        self.motion = keyframes.relative_poses(directed)
        self.inverse_depth = keyframes.inverse_depths([e[0] for e in directed])

    def project(self) -> Float[Tensor, "e p 2"]:
        """Return the positions of the sources' cells in the targets."""
        grid = self.grid
        return project(grid.camera, grid.rays, self.motion, self.inverse_depth).pixels

    def moved(
        self, before: Float[Tensor, "e p 2"], weight: Float[Tensor, "e p 2"]
    ) -> Float[Tensor, "e"]:
        """Return the median motion in pixels of the matched cells from ``before``."""
        moved = (self.project() - before).norm(dim=-1)
        return moved.masked_fill(~(weight[..., 0] > 0), torch.nan).nanmedian(dim=1).values

    def distances(self, rotation_weight: float) -> Float[Tensor, "e"]:
        """Return DROID-SLAM's distance in pixels; infinite at little overlap.

        Mean of the flow (weight ``rotation_weight``) and of the flow without the rotation (the
        rest) over every second of the cells that stay in front of the target; infinite where
        less than 3/4 do or where less than a fifth falls into the image.
        """
        grid = self.grid
        T = self.motion
        keep = torch.zeros(grid.height, grid.width, dtype=torch.bool)
        keep[::CELL_STEP, ::CELL_STEP] = True
        keep = keep.reshape(-1)
        rays = grid.rays[keep]
        pixels = grid.pixels[keep]
        d = self.inverse_depth[:, keep]
        shift = T.clone()
        shift[:, :3, :3] = torch.eye(3, dtype=T.dtype)
        total = valid = inside = torch.zeros(len(T))
        for motion, factor in ((T, rotation_weight), (shift, 1 - rotation_weight)):
            p = project(grid.camera, rays, motion, d)
            flow = (p.pixels - pixels).norm(dim=-1)
            total = total + factor * (flow * p.valid).sum(1)
            valid = valid + factor * p.valid.float().sum(1)
            if motion is T:
                inside = (grid.inside(p.pixels) & p.valid).float().mean(1)
        seen = (valid > 0.75 * int(keep.sum())) & (inside > LEAST_OVERLAP)
        return torch.where(seen, total / valid.clamp(min=1e-6), torch.inf)
