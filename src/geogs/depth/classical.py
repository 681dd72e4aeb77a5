"""Keyframe depths by matching and fusion without a network, on the CPU.

Compiled code is imported by the first keyframe that needs it, long after the first frame.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.depth.depth_engine import DepthTask, Progress, silent
from geogs.depth.depth_view import DenseDepth, DepthView, PosedDepth
from geogs.geometry.camera import Camera
from geogs.threads import thread_map

# Views whose depths may be in memory at once.
_FEW_VIEWS = 128


class CpuDepthEngine:
    """Depth engine of compiled loops; keyframes, and the rows of each, run in parallel."""

    def __init__(self, render: Camera, working: Camera, planes: int) -> None:
        """``planes`` is the largest number of planes of a sweep."""
        self.render = render
        self.working = working
        self.planes = planes

    def observe(self, view: DepthView) -> None:
        """As in the protocol; here nothing is kept."""

    def estimate(self, tasks: Sequence[DepthTask], progress: Progress = silent) -> list[DenseDepth]:
        """As in the protocol."""
        from geogs.depth.estimate import estimate_depth

        def one(task: DepthTask) -> DenseDepth:
            cameras = self.render, self.working
            found = estimate_depth(task.view, task.neighbours, *cameras, task.limits, self.planes)
            return DenseDepth.of(found)

        return thread_map(one, tasks, progress)

    def check(
        self, depths: Sequence[PosedDepth], others: Sequence[Sequence[PosedDepth]]
    ) -> list[DenseDepth]:
        """As in the protocol."""
        from geogs.depth.fusion import check_depth

        def one(pair: tuple[PosedDepth, Sequence[PosedDepth]]) -> DenseDepth:
            own, rest = pair
            if not rest:
                return own.depth
            arrays = [o.depth.arrays() for o in rest]
            poses = [o.T_cw for o in rest]
            checked = check_depth(own.depth.arrays(), own.T_cw, arrays, poses, self.render)
            return replace(DenseDepth.of(checked), normal=own.depth.normal)

        return thread_map(one, list(zip(depths, others, strict=True)))

    def keep(self, points: Float[Tensor, "n 3"], depths: Sequence[PosedDepth]) -> Bool[Tensor, "n"]:
        """As in the protocol."""
        from geogs.depth.carve import vote
        from geogs.splat.cpu.in_view import disks_in_view

        seen = torch.ones(len(points), dtype=torch.bool)
        # Many views are read one after the other, so that not all are in memory at once.
        if 0 < len(depths) <= _FEW_VIEWS:
            depths = list(depths)
            poses = torch.from_numpy(np.stack([d.T_cw for d in depths]))
            # No view votes on the others, which may be most of a large map.
            seen = disks_in_view(points, points.new_zeros(len(points)), poses, self.render)
        kept = torch.ones_like(seen)
        views = ((d.T_cw, d.depth.through_sky().arrays()) for d in depths)
        kept[seen] = torch.from_numpy(vote(points.detach()[seen].numpy(), views, self.render))
        return kept

    def photo_costs(
        self,
        view: DepthView,
        others: Sequence[DepthView],
        depths: Float[Tensor, "2 h w"],
        same: Bool[Tensor, "h w"],
        mask: Bool[Tensor, "h w"] | None = None,
    ) -> Float[Tensor, "2 h w"]:
        """As in the protocol."""
        from geogs.depth.revision.photo_vote import photo_costs

        return photo_costs(view, others, depths, same, self.render, mask)

    def farther_surface(self, depth: Float[Tensor, "h w"], reach: int) -> Float[Tensor, "h w"]:
        """As in the protocol."""
        from geogs.depth.revision.revised_searches import farther_surface

        return farther_surface(depth, reach)
