"""What a term of a Sim(3) pose graph, relative poses or dense matches, is given and gives.

Inverse depths that a term has along with the similarities it eliminates itself. The graph is solved
on the CPU, also where the tracker is on a GPU.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class GraphState:
    """What is adjusted, at its present values."""

    S: Float[Tensor, "n 4 4"]
    """World to camera in each keyframe's own unit of length, float64."""
    inverse_depth: Float[Tensor, "n p"] | None = None
    """In the keyframe's unit; none without matches."""


@dataclass(frozen=True)
class BlockEquations:
    """Contributions to normal equations in blocks of one keyframe each."""

    row: Int[Tensor, "b"]
    column: Int[Tensor, "b"]
    block: Float[Tensor, "b 7 7"]
    """Added to the matrix at keyframes (row, column); float64."""
    gradient: Float[Tensor, "n 7"]
    """Right-hand side, the direction of descent; float64."""

    def without_scale(self) -> "BlockEquations":
        """The same equations with nothing that moves a scale."""
        rigid = torch.ones(7, dtype=torch.float64)
        rigid[6] = 0
        block = self.block * rigid[:, None] * rigid
        return BlockEquations(self.row, self.column, block, self.gradient * rigid)
