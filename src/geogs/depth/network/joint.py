"""The classical search and the network: their mean where they agree, else one by the images."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.depth.depth_engine import AlternativeSearch, DepthEngine, DepthTask, Progress, silent
from geogs.depth.depth_view import DenseDepth, dense_depths

REACH = 0.03
"""Relative distance within which two depths are of one surface, and averaged."""
VOTE = (14.0, 0.8)
"""Coefficients of the logit of the chance that of two depths the network's is right: of the images'
vote, and a constant."""
AGREE, DIFFER = (0.74, 0.53, 0.28), (0.57, -0.23, 0.41, -0.85)
"""Coefficients of the logit of the chance that the result is right. Where both agree: of the larger
and the smaller of their logits, and a constant; where not: of the logits of what was chosen and of
the other, of the choice, and a constant. All are logistic regressions on eight keyframes of four
rendered rooms."""
_BOUND = 0.02


class JointDepthEngine(AlternativeSearch):
    """Searches with both engines and joins their depths; normals are the network's."""

    def __init__(self, network: DepthEngine, classical: DepthEngine) -> None:
        super().__init__(classical)
        self.network = network

    def estimate(self, tasks: Sequence[DepthTask], progress: Progress = silent) -> list[DenseDepth]:
        """As in the protocol."""
        learned = self.network.estimate(tasks, lambda done: progress(0.5 * done))
        searched = self.classical.estimate(tasks, lambda done: progress(0.5 + 0.5 * done))
        return [
            self._joined(task, s, n) if task.neighbours else n
            for task, s, n in zip(tasks, searched, learned, strict=True)
        ]

    def _joined(self, task: DepthTask, searched: DenseDepth, learned: DenseDepth) -> DenseDepth:
        depths = torch.stack([searched.depth, learned.depth])
        same = agreement(searched, learned)
        costs = self.classical.photo_costs(task.view, task.neighbours, depths, same)
        return joined(searched, learned, costs[0] - costs[1])


def agreement(first: DenseDepth, second: DenseDepth) -> Bool[Tensor, "h w"]:
    """Where both depths are of one surface."""
    return (first.depth.log() - second.depth.log()).abs() < REACH


def joined(first: DenseDepth, second: DenseDepth, vote: Float[Tensor, "h w"]) -> DenseDepth:
    """One depth of two; normals are the second's.

    Where they agree it is the mean of their logarithms, weighted by the squared precision of a
    normal error that is below 2 % with the chance of their confidence: squared, as the most
    confident are more precise than that. Elsewhere it is the likelier one by the ``vote`` of the
    images, the first one's ``photo_costs`` less the second's.
    """
    confidence = torch.stack([first.confidence, second.confidence])
    logs = torch.stack([first.depth, second.depth]).log()
    bounded = confidence.clamp(_BOUND, 1 - _BOUND)
    weight = bounded.erfinv().pow(4)
    mean = (weight * logs).sum(0) / weight.sum(0)
    choice = VOTE[0] * vote + VOTE[1]
    agree, take = agreement(first, second), choice < 0
    depth = torch.where(agree, mean, torch.where(take, logs[0], logs[1])).exp()
    logit = bounded.logit()
    chosen, other = torch.where(take, logit, logit.flip(0))
    both = AGREE[0] * logit.amax(0) + AGREE[1] * logit.amin(0) + AGREE[2]
    alone = DIFFER[0] * chosen + DIFFER[1] * other + DIFFER[2] * choice.abs() + DIFFER[3]
    (found,) = dense_depths([(depth, torch.where(agree, both, alone).sigmoid())])
    return replace(found, normal=second.normal)
