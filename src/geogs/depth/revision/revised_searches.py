"""Searches whose depths are revised one by one: beside edges, and in the sky.

Photometric costs (``photo_costs``) decide.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.depth.depth_engine import AlternativeSearch, DepthEngine, DepthTask, Progress, silent
from geogs.depth.depth_view import INFINITY, DenseDepth, DepthView, PosedDepth, dense_depths
from geogs.geometry.jumps import minmod_slopes
from geogs.threads import thread_map

MIN_GAP = 0.03
"""Relative difference of inverse depth from which a nearby pixel is of a farther surface."""
REACH = 0.019
"""Distance within which it is searched, in long edges of the image: 6 pixels of 320."""
PASSES = 2
"""Rounds over all pixels."""
MOVED_CONFIDENCE = 0.35
"""Confidence of a depth that was moved to the farther surface, as measured."""
FAR_RATIO = 2.0
"""Depth over the median depth from which a pixel may be sky: a bare wall nearby looks the same at
any depth."""
_MIN_FAR = 0.005
"""Least fraction of far pixels for which a view is searched."""
MAX_EXCESS = 0.03
"""Largest cost at infinity minus that at the searched depth: their noise where both are right."""
MAX_COST = 0.3
"""Largest cost of the sky at infinity; that of a surface is 0.4 at its depth, 0.9 at infinity."""
_CONFIDENT = 0.5
"""Confidence above which depths serve to estimate the noise and offset between images."""


class RevisedSearch(AlternativeSearch, ABC):
    """Another engine's search, followed by a revision of each single depth."""

    def estimate(self, tasks: Sequence[DepthTask], progress: Progress = silent) -> list[DenseDepth]:
        """As in the protocol."""
        searched = self.classical.estimate(tasks, progress)

        def one(pair: tuple[DepthTask, DenseDepth]) -> DenseDepth:
            task, found = pair
            return self.revised(task.view, task.neighbours, found)

        return thread_map(one, list(zip(tasks, searched, strict=True)))

    @abstractmethod
    def revised(
        self, view: DepthView, others: Sequence[DepthView], searched: DenseDepth
    ) -> DenseDepth:
        """The revised depth of a view that was matched with some others."""


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
        depth = searched.depth
        confidence = searched.confidence
        for _ in range(PASSES):
            beyond = self.classical.farther_surface(depth, round(REACH * max(depth.shape)))
            there = beyond > 0
            depths = torch.stack([depth, beyond])
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
    found = np.zeros_like(planes.numpy())
    least = planes[0].amin().numpy()
    farther_planes(planes.numpy(), least, np.float32(1 - MIN_GAP), reach, found)
    return as_depth(torch.from_numpy(found[0]))


def inverse_planes(depth: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Inverse depth and its slopes per pixel; the depth is positive."""
    inverse = 1 / depth
    return torch.stack([inverse, *minmod_slopes(inverse, depth > 0)])


def as_depth(inverse: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Depth of an inverse depth; 0 where it is 0."""
    return torch.where(inverse > 0, 1 / inverse.clamp(min=1e-12), 0.0)


class SkySearch(RevisedSearch):
    """Another search with sky where the images agree as well at infinity."""

    def revised(
        self, view: DepthView, others: Sequence[DepthView], searched: DenseDepth
    ) -> DenseDepth:
        """The depth with its sky."""
        return searched.under(unbounded(view, others, searched, self.classical))

    def check(
        self, depths: Sequence[PosedDepth], others: Sequence[Sequence[PosedDepth]]
    ) -> list[DenseDepth]:
        """As in the protocol; the sky stays."""
        checked = self.classical.check(depths, others)
        return [found.under(own.depth.sky) for own, found in zip(depths, checked, strict=True)]


def unbounded(
    view: DepthView, others: Sequence[DepthView], found: DenseDepth, engine: DepthEngine
) -> Bool[Tensor, "h w"] | None:
    """Far pixels whose cost at infinity (rotations alone count) is no worse than at their depth.

    Costs are means over single pixels of like colour (``photo_costs``), so a roof does not affect
    the sky beside it. None if there are none, few pixels are far, or there are no other views.
    """
    confident = found.confidence > _CONFIDENT
    if not others or not bool(confident.any()):
        return None
    typical = found.depth[confident].median()
    is_far = found.depth > FAR_RATIO * typical
    if float(is_far.float().mean()) < _MIN_FAR:
        return None
    depths = torch.stack([found.depth, (INFINITY * typical).expand_as(found.depth)])
    here, beyond = engine.photo_costs(view, others, depths, confident)
    is_sky = is_far & (beyond < MAX_COST) & (beyond < here + MAX_EXCESS)
    return is_sky if bool(is_sky.any()) else None
