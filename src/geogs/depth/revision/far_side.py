"""Pixels that a search has put on the nearer side of an edge, and the images on the farther one."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.depth.depth_engine import RevisedSearch
from geogs.depth.depth_view import DenseDepth, DepthView, dense_depths
from geogs.geometry.jumps import minmod_slopes

APART = 0.03
"""Relative difference of inverse depth from which what is around is a farther surface."""
REACH = 0.019
"""How far away that may be, in long edges of the image: 6 pixels of 320."""
PASSES = 2
"""Times that all pixels are asked."""
MOVED_CONFIDENCE = 0.35
"""Confidence of a depth that was moved, as measured."""


class FarSideSearch(RevisedSearch):
    """A search whose windows grow the foreground by some pixels, without these.

    Where a farther surface lies beside a pixel, its plane goes on to it, and the pixel takes it if
    the neighbours' images agree better there (``photo_costs``).
    """

    def revised(
        self, view: DepthView, others: Sequence[DepthView], searched: DenseDepth
    ) -> DenseDepth:
        """With the far side where that is likelier."""
        if not others:
            return searched
        depth, confidence = searched.depth, searched.confidence
        for _ in range(PASSES):
            beyond = self.classical.farther_surface(depth, round(REACH * max(depth.shape)), APART)
            there, depths = beyond > 0, torch.stack([depth, beyond])
            here, other = self.classical.photo_costs(view, others, depths, ~there, there)
            depth = torch.where(other < here, beyond, depth)
            confidence = torch.where(other < here, MOVED_CONFIDENCE, confidence)
        (found,) = dense_depths([(depth, confidence)])
        return found


def farther_surface(depth: Float[Tensor, "h w"], reach: int, apart: float) -> Float[Tensor, "h w"]:
    """Depth of the nearest farther surface within ``reach`` pixels, its plane gone on to the pixel.

    0 where there is none that is farther by ``apart`` of the inverse depth, or it would be farther
    than all that was found. ``depth`` is positive; inverse depth is linear along a plane.
    """
    from geogs.depth.revision.far_side_kernels import farther_planes

    planes = inverse_planes(depth)
    found, least = np.zeros_like(planes.numpy()), planes[0].amin().numpy()
    farther_planes(planes.numpy(), least, np.float32(1 - apart), reach, found)
    return as_depth(torch.from_numpy(found[0]))


def inverse_planes(depth: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Inverse depth and its slopes per pixel; the depth is positive."""
    inverse = 1 / depth
    return torch.stack([inverse, *minmod_slopes(inverse, depth > 0)])


def as_depth(inverse: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Depth of an inverse depth, 0 where that is none."""
    return torch.where(inverse > 0, 1 / inverse.clamp(min=1e-12), 0.0)
