"""Sky: pixels whose depth no parallax bounds from above."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from geogs.depth.depth_engine import DepthEngine, RevisedSearch
from geogs.depth.depth_view import INFINITY, DenseDepth, DepthView, PosedDepth

FAR = 2.0
"""Times the median depth from which a pixel is asked: a bare wall nearby looks the same at any
depth, and is none of these."""
_ASKED = 0.005
"""Least part of a view for which it is worth it."""
WORSE = 0.03
"""By how much the cost at infinity may exceed that of the depth found: their difference has so much
noise where both are right."""
AGREES = 0.3
"""Cost up to which images agree: surfaces that are found right have 0.4, seen at infinity 0.9."""
_SURE = 0.5
"""Least confidence of depths from which noise and light are learned."""


class SkySearch(RevisedSearch):
    """A search that finds sky where the images agree as well at infinity."""

    def revised(
        self, view: DepthView, others: Sequence[DepthView], searched: DenseDepth
    ) -> DenseDepth:
        """With its sky."""
        return searched.under(unbounded(view, others, searched, self.classical))

    def check(
        self, depths: Sequence[PosedDepth], others: Sequence[Sequence[PosedDepth]]
    ) -> list[DenseDepth]:
        """As in the protocol; what is sky stays sky."""
        checked = self.classical.check(depths, others)
        return [found.under(own.depth.sky) for own, found in zip(depths, checked, strict=True)]


def unbounded(
    view: DepthView, others: Sequence[DepthView], found: DenseDepth, engine: DepthEngine
) -> Bool[Tensor, "h w"] | None:
    """Far pixels where the other views agree at infinity, and not worse than at the depth found.

    At infinity only the rotations between the views count. What is asked is a mean over single
    pixels of like colour (``photo_costs``), so that a roof says nothing of the sky beside it.
    None where there are none, hardly a pixel is far, or there is nothing to compare with.
    """
    sure = found.confidence > _SURE
    if not others or not bool(sure.any()):
        return None
    typical = found.depth[sure].median()
    is_far = found.depth > FAR * typical
    if float(is_far.float().mean()) < _ASKED:
        return None
    depths = torch.stack([found.depth, (INFINITY * typical).expand_as(found.depth)])
    here, beyond = engine.photo_costs(view, others, depths, sure)
    is_sky = is_far & (beyond < AGREES) & (beyond < here + WORSE)
    return is_sky if bool(is_sky.any()) else None
