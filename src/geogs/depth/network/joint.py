"""The classical search and the network together: the one where there is texture, the other else."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch.nn import functional

from geogs.depth.depth_engine import AlternativeSearch, DepthEngine, Limits, Progress, silent
from geogs.depth.depth_view import DenseDepth, DepthView, dense_depths

REACH = 0.03
"""Relative distance within which two depths are of one surface, and averaged."""
WINDOW = 7
"""Pixels across and down over whose mean confidences it is decided who is right elsewhere."""
AGREE, APART = (0.8, 0.2, 0.75), (0.85, -0.3, -0.35)
"""Logit of the chance that the result is right, from those of what was chosen and of the other and
a constant: where both agree (the more confident one is what was chosen) and where not. A logistic
regression on four keyframes of two rendered rooms."""
_BOUND = 0.02


class JointDepthEngine(AlternativeSearch):
    """Searches with both engines, and takes of each what it knows; normals are the network's."""

    def __init__(self, network: DepthEngine, classical: DepthEngine) -> None:
        super().__init__(classical)
        self.network = network

    def estimate(
        self,
        references: Sequence[DepthView],
        neighbours: Sequence[Sequence[DepthView]],
        progress: Progress = silent,
        limits: Sequence[Limits | None] | None = None,
    ) -> list[DenseDepth]:
        """As in the protocol."""
        learned = self.network.estimate(
            references, neighbours, lambda done: progress(0.5 * done), limits
        )
        searched = self.classical.estimate(
            references, neighbours, lambda done: progress(0.5 + 0.5 * done), limits
        )
        return [
            joined(s, n) if others else n
            for s, n, others in zip(searched, learned, neighbours, strict=True)
        ]


def joined(first: DenseDepth, second: DenseDepth) -> DenseDepth:
    """One depth of two; normals are the second's.

    Where they differ by less than ``REACH`` it is the mean of their logarithms, weighted by the
    squared precision of normal errors that are below 2 % with the chance that the confidences say;
    elsewhere that which is more confident around the pixel. Squared, because the most confident are
    more precise than a chance tells.
    """
    confidence = torch.stack([first.confidence, second.confidence])
    logs = torch.stack([first.depth, second.depth]).log()
    bounded = confidence.clamp(_BOUND, 1 - _BOUND)
    weight = bounded.erfinv().pow(4)
    mean = (weight * logs).sum(0) / weight.sum(0)
    agree = (logs[0] - logs[1]).abs() < REACH
    around = functional.avg_pool2d(confidence[None], WINDOW, 1, WINDOW // 2)[0]
    take = around[0] > around[1]
    depth = torch.where(agree, mean, torch.where(take, logs[0], logs[1])).exp()
    logit = bounded.logit()
    other = torch.where(take, logit[1], logit[0])
    chosen = torch.where(take, logit[0], logit[1])
    both = AGREE[0] * logit.amax(0) + AGREE[1] * logit.amin(0) + AGREE[2]
    alone = APART[0] * chosen + APART[1] * other + APART[2]
    (found,) = dense_depths([(depth, torch.where(agree, both, alone).sigmoid())])
    return replace(found, normal=second.normal)
