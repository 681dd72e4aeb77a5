"""Revision of depths beside an edge: the farther surface where images agree better with it."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.depth.depth_engine import RevisedSearch
from geogs.depth.depth_view import DenseDepth, DepthView, dense_depths
from geogs.geometry.jumps import minmod_slopes

MIN_GAP = 0.03
"""Relative difference of inverse depth from which a nearby pixel is of a farther surface."""
REACH = 0.019
"""Distance within which it is searched, in long edges of the image: 6 pixels of 320."""
PASSES = 2
"""Rounds over all pixels."""
MOVED_CONFIDENCE = 0.35
"""Confidence of a depth that was moved to the farther surface, as measured."""


class FarSideSearch(RevisedSearch):
    """Undoes the fattening of the foreground by the windows of another search.

    The plane of a farther surface beside a pixel is extended to it, and the pixel takes it if the
    neighbours' images agree better there (``photo_costs``).
    """

    def revised(
        self, view: DepthView, others: Sequence[DepthView], searched: DenseDepth
    ) -> DenseDepth:
        """The depth with the farther surface where that is likelier."""
        if not others:
            return searched
        depth, confidence = searched.depth, searched.confidence
        for _ in range(PASSES):
            beyond = self.classical.farther_surface(depth, round(REACH * max(depth.shape)))
            there, depths = beyond > 0, torch.stack([depth, beyond])
            here, other = self.classical.photo_costs(view, others, depths, ~there, there)
            depth = torch.where(other < here, beyond, depth)
            confidence = torch.where(other < here, MOVED_CONFIDENCE, confidence)
        (found,) = dense_depths([(depth, confidence)])
        return found


def farther_surface(depth: Float[Tensor, "h w"], reach: int) -> Float[Tensor, "h w"]:
    """Depth at each pixel of the plane of the nearest farther surface within ``reach`` pixels.

    0 where none is farther by ``MIN_GAP`` of the inverse depth, or its plane is beyond the farthest
    depth of all. ``depth`` is positive; inverse depth is linear along a plane.
    """
    from geogs.depth.revision.far_side_kernels import farther_planes

    planes = inverse_planes(depth)
    found, least = np.zeros_like(planes.numpy()), planes[0].amin().numpy()
    farther_planes(planes.numpy(), least, np.float32(1 - MIN_GAP), reach, found)
    return as_depth(torch.from_numpy(found[0]))


def inverse_planes(depth: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Inverse depth and its slopes per pixel; the depth is positive."""
    inverse = 1 / depth
    return torch.stack([inverse, *minmod_slopes(inverse, depth > 0)])


def as_depth(inverse: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Depth of an inverse depth; 0 where it is 0."""
    return torch.where(inverse > 0, 1 / inverse.clamp(min=1e-12), 0.0)
