"""Sky: pixels whose depth no parallax bounds from above."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from geogs.depth.depth_engine import DepthEngine, RevisedSearch
from geogs.depth.depth_view import INFINITY, DenseDepth, DepthView, PosedDepth

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
