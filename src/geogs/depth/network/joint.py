"""The classical search and the network: a mean where they agree, elsewhere the likelier one."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.depth.depth_engine import AlternativeSearch, DepthEngine, DepthTask, Progress, silent
from geogs.depth.depth_view import DenseDepth, dense_depths

REACH = 0.03
"""Relative distance within which two depths are of one surface, and averaged."""
MEAN, CHOICE = (45.0, 0.63, 0.16, 0.35), (12.0, 0.55, 0.52, 0.5)
"""Coefficients of two logits: of the network's weight in the mean, and of the chance that its depth
is the right one. They multiply the images' vote, the logit of the search's confidence (subtracted)
and that of the network's; the last is a constant. MEAN minimises the mean of
log(1 + (error / 0.5 %)²), CHOICE is a logistic regression, on eight rooms and streets."""
AGREE, DIFFER = (0.74, 0.53, 0.28), (0.35, 0.17, 0.41, -0.54)
"""Coefficients of the logit of the chance that the result is right to 2 %. Where both agree: of the
larger and the smaller of their logits, and a constant; where not: of the logits of the chosen depth
and of the other, of the size of the choice's logit, and a constant. Logistic regressions as well,
the first on eight keyframes of four rooms."""
BOUND = 0.02
"""Least distance of a confidence from 0 and 1 where its logit is taken."""


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
    """Whether both depths of each pixel are of one surface."""
    return (first.depth.log() - second.depth.log()).abs() < REACH


def joined(first: DenseDepth, second: DenseDepth, vote: Float[Tensor, "h w"]) -> DenseDepth:
    """Join two depths; normals are the second's.

    Where they agree the result is a mean of their logarithms, elsewhere the likelier one. Both
    depend on the confidences and the images' ``vote``: the first one's ``photo_costs`` minus the
    second's.
    """
    logs = torch.stack([first.depth, second.depth]).log()
    confidence = torch.stack([first.confidence, second.confidence])
    logit = confidence.clamp(BOUND, 1 - BOUND).logit()
    weight, choice = (speaks_for_second(by, vote, logit) for by in (MEAN, CHOICE))
    mean = torch.lerp(logs[0], logs[1], weight.sigmoid())
    agree, take = agreement(first, second), choice < 0
    depth = torch.where(agree, mean, torch.where(take, logs[0], logs[1])).exp()
    chosen, other = torch.where(take, logit, logit.flip(0))
    both = AGREE[0] * logit.amax(0) + AGREE[1] * logit.amin(0) + AGREE[2]
    alone = DIFFER[0] * chosen + DIFFER[1] * other + DIFFER[2] * choice.abs() + DIFFER[3]
    (found,) = dense_depths([(depth, torch.where(agree, both, alone).sigmoid())])
    return replace(found, normal=second.normal)


def speaks_for_second(
    by: tuple[float, float, float, float] | Float[Tensor, "4"],
    vote: Float[Tensor, "*n"],
    logit: Float[Tensor, "2 *n"],
) -> Float[Tensor, "*n"]:
    """Logit in favour of the second of two depths, given the logits of their confidences."""
    return by[0] * vote - by[1] * logit[0] + by[2] * logit[1] + by[3]
