"""Sky: pixels whose depth no parallax bounds from above."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.depth.depth_engine import DepthEngine
from geogs.depth.depth_view import DenseDepth, DepthView, PosedDepth
from geogs.depth.revision.revised_search import RevisedSearch
from geogs.on_demand import OnDemand

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
_INFINITY = 1e6
"""Times the median depth."""


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

    def keep(self, points: Float[Tensor, "n 3"], depths: Sequence[PosedDepth]) -> Bool[Tensor, "n"]:
        """As in the protocol; all that is seen in the sky stands in free space."""
        return self.classical.keep(points, OnDemand(depths, _with_sky_far_away))


def _with_sky_far_away(posed: PosedDepth) -> PosedDepth:
    """The sky as a depth that is sure, and behind everything."""
    found = posed.depth
    if found.sky is None:
        return posed
    far = torch.where(found.sky, _INFINITY * found.depth, found.depth)
    sure = torch.where(found.sky, 1.0, found.confidence)
    return replace(posed, depth=replace(found, depth=far, confidence=sure))


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
    depths = torch.stack([found.depth, (_INFINITY * typical).expand_as(found.depth)])
    here, beyond = engine.photo_costs(view, others, depths, sure)
    is_sky = is_far & (beyond < AGREES) & (beyond < here + WORSE)
    return is_sky if bool(is_sky.any()) else None
