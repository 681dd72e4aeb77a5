"""Depths that might as well be infinite: the sky, and what no parallax holds on this side of it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.depth.depth_engine import AlternativeSearch, DepthEngine, Limits, Progress, silent
from geogs.depth.depth_view import DenseDepth, DepthView
from geogs.depth.sweep_neighbors import RANGE_MARGIN, depth_range
from geogs.geometry.camera import Camera

LEAST_SHIFT = 0.016
"""Part of the long edge by which a point has to move in some neighbour's image against one at
infinity; below, windows at the end of the search do not tell the two apart."""
_LEAST_Z = 0.05
"""Part of a point's depth that it keeps in a neighbour's frame; nearer ones project wildly."""


class BoundedSearch(AlternativeSearch):
    """An engine whose depths have no confidence where nothing bounds them from above.

    That is where a depth ends beyond all that the tracker knows, at the far end of what was
    searched, and the images would hardly look otherwise if it were infinite. So no disk is made
    there, and the sky does not become a dome.
    """

    def __init__(self, engine: DepthEngine, render: Camera, working: Camera) -> None:
        super().__init__(engine)
        self.render, self.working = render, working

    def estimate(
        self,
        references: Sequence[DepthView],
        neighbours: Sequence[Sequence[DepthView]],
        progress: Progress = silent,
        limits: Sequence[Limits | None] | None = None,
    ) -> list[DenseDepth]:
        """As in the protocol."""
        found = self.classical.estimate(references, neighbours, progress, limits)
        tasks = zip(references, neighbours, limits or [None] * len(found), found, strict=True)
        return [self._bounded(*task) for task in tasks]

    def _bounded(
        self,
        view: DepthView,
        others: Sequence[DepthView],
        limits: Limits | None,
        found: DenseDepth,
    ) -> DenseDepth:
        if not others:
            return found
        _, far = limits or depth_range(view, others, self.working)
        poses = np.stack([v.T_cw for v in others]) @ np.linalg.inv(view.T_cw)
        shift = shift_from_infinity(found.depth, poses, self.render)
        is_open = found.depth > far / RANGE_MARGIN
        is_open &= shift < LEAST_SHIFT * self.render.long_edge
        return replace(found, confidence=torch.where(is_open, 0.0, found.confidence))


def shift_from_infinity(
    depth: Float[Tensor, "h w"], poses: Float[np.ndarray, "n 4 4"], camera: Camera
) -> Float[Tensor, "h w"]:
    """Pixels by which points move if they go to infinity, in the neighbour where that is most.

    ``poses`` take the frame of the depth map to the neighbours'. Only neighbours whose image has
    the point, and its direction in front of them, count; 0 where there is none.
    """
    rays = camera.rays(device=depth.device)
    scale = rays.new_tensor([camera.fx, camera.fy])
    most = torch.zeros_like(depth)
    for T in torch.from_numpy(poses).to(rays):
        direction = rays @ T[:3, :3].mT
        point = direction + T[:3, 3] / depth[..., None]
        ahead = (direction[..., 2] > _LEAST_Z) & (point[..., 2] > _LEAST_Z)
        seen, end = (x[..., :2] / x[..., 2:].clamp(min=_LEAST_Z) for x in (point, direction))
        inside = _in_image(seen * scale, camera)
        shift = ((seen - end) * scale).norm(dim=-1)
        most = torch.where(ahead & inside, torch.maximum(most, shift), most)
    return most


def _in_image(offset: Float[Tensor, "h w 2"], camera: Camera) -> Bool[Tensor, "h w"]:
    """Whether places relative to the principal point lie in the image."""
    u, v = offset[..., 0] + camera.cx, offset[..., 1] + camera.cy
    return (u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1)
