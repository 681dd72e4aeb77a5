"""Fields on the sample grid on the CPU: filling holes, propagating depth from view to view."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.projection import project
from geogs.geometry.lie import se3_inverse
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe


class GridFields:
    """Operations on fields over the cells of a grid, on the CPU."""

    def __init__(self, grid: SampleGrid) -> None:
        self.grid = grid

    def fill(
        self, values: Float[Tensor, "*n p"], confidence: Float[Tensor, "*n p"]
    ) -> Float[Tensor, "*n p"]:
        """Keep values where confidence is positive; fill others with the mean around them.

        Push and pull: confidence-weighted means over growing blocks, taken from the finest level
        with any confidence nearby. Without any confidence the plain mean of a field is returned.
        """
        rows = (x.reshape(-1, self.grid.size) for x in (values, confidence))
        filled = [self._fill(*pair) for pair in zip(*rows, strict=True)]
        return torch.stack(filled).reshape(values.shape)

    def _fill(
        self, values: Float[Tensor, "p"], confidence: Float[Tensor, "p"]
    ) -> Float[Tensor, "p"]:
        if not bool((confidence > 0).any()):
            return torch.full_like(values, float(values.mean()))
        shape = (1, 1, self.grid.height, self.grid.width)
        value = values.reshape(shape)
        weight = confidence.reshape(shape).clamp(min=0)
        return torch.where(
            confidence > 0, values, _push_pull(value, weight).reshape(-1).to(values.dtype)
        )

    def transfer(
        self,
        T_ji: Float[Tensor, "4 4"],
        inverse_depth: Float[Tensor, "p"],
        information: Float[Tensor, "p"],
    ) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"]]:
        """Transfer inverse depth and information from frame i to frame j; nearest surface wins.

        Empty cells are filled from their surroundings and have no information.
        """
        grid = self.grid
        R = T_ji[:3, :3].to(inverse_depth)
        t = T_ji[:3, 3].to(inverse_depth)
        z = (grid.rays @ R.mT + inverse_depth[:, None] * t)[:, 2]
        p = project(grid.camera, grid.rays, T_ji[None], inverse_depth[None])
        cell, hit = grid.cells_of(p.pixels[0])
        hit &= p.valid[0]
        moved = torch.where(hit, inverse_depth / z.clamp(min=1e-6), torch.zeros_like(z))
        depth = torch.zeros_like(moved).scatter_reduce(0, cell, moved, "amax")
        nearest = hit & (moved >= 0.98 * depth[cell])
        kept = torch.where(nearest, information * z.square(), torch.zeros_like(z))
        transferred = torch.zeros_like(kept).scatter_reduce(0, cell, kept, "amax")
        seen = depth > 0
        # A small confidence lets cells without information contribute weakly to filling.
        return self.fill(depth, torch.where(seen, transferred + 1e-6, 0.0)), transferred * seen

    def reproject(
        self, keyframes: Sequence[Keyframe], T_cw: Sequence[Float[Tensor, "4 4"]]
    ) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]:
        """Project cells of each keyframe into a frame at ``T_cw``, and the frame's cells back.

        The frame has no depth of its own; it uses the keyframe's.
        """
        grid = self.grid
        there = []
        back = []
        for keyframe, T_frame in zip(keyframes, T_cw, strict=True):
            own = keyframe.inverse_depth
            T = T_frame @ se3_inverse(keyframe.T_cw)
            depth, _ = self.transfer(T, own, keyframe.information)
            there.append(project(grid.camera, grid.rays, T[None], own[None]).pixels)
            back.append(project(grid.camera, grid.rays, se3_inverse(T)[None], depth[None]).pixels)
        return torch.cat(there), torch.cat(back)


def _push_pull(
    value: Float[Tensor, "1 1 h w"], weight: Float[Tensor, "1 1 h w"]
) -> Float[Tensor, "1 1 h w"]:
    pool = torch.nn.functional.avg_pool2d
    if min(value.shape[-2:]) <= 2:
        return ((value * weight).sum() / weight.sum()).expand_as(value)
    w = pool(weight, 2, ceil_mode=True)
    v = pool(value * weight, 2, ceil_mode=True) / w.clamp(min=1e-30)
    coarse = torch.nn.functional.interpolate(
        _push_pull(v, w), size=value.shape[-2:], mode="bilinear", align_corners=False
    )
    return torch.where(weight > 0, value, coarse)
