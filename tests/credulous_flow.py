"""A flow operator that believes what it is told, as a smoothed flow can."""

from collections.abc import Sequence

import torch
from torch import Tensor

from geogs.tracking.flow.classical_flow import ClassicalFlow, ClassicalImage
from geogs.tracking.flow.flow_operator import Memories
from geogs.types import FlowMatch


class CredulousFlow(ClassicalFlow):
    """Where images hardly match, it finds every cell where it was told to look, and is sure."""

    def measure(
        self,
        first: Sequence[ClassicalImage],
        second: Sequence[ClassicalImage],
        forward: Tensor | None = None,
        backward: Tensor | None = None,
        fine: bool = True,
        memory: Memories | None = None,
    ) -> tuple[FlowMatch, FlowMatch]:
        """The classical matches, or all of them."""
        there, back = super().measure(first, second, forward, backward, fine, memory)
        return self._believed(there, forward), self._believed(back, backward)

    def _believed(self, match: FlowMatch, told: Tensor | None) -> FlowMatch:
        hardly = (match.weight[..., 0] > 0).float().mean(1)[:, None, None] < 0.3
        told = self.grid.pixels if told is None else told
        pixels = torch.where(hardly, told.to(match.pixels), match.pixels)
        return FlowMatch(pixels, torch.where(hardly, 25.0, match.weight))
