"""The terms of a Sim(3) pose graph: what a kind of measurement says of keyframes' similarities.

A new kind is one class with :meth:`GraphTerm.linearise`, entered in ``PoseGraph.terms``. Inverse
depths that a term has along with the similarities it eliminates itself. The graph is solved on the
CPU, also where the tracker is on a GPU.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

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


@runtime_checkable
class LinearTerm(Protocol):
    """A term linearised at one state."""

    def equations(self, damping: float) -> BlockEquations:
        """Over the keyframes; depths resist by ``damping`` relative to their curvature, too."""
        ...

    def cost(self, state: GraphState) -> float:
        """At any state, over the residuals that count where it was linearised."""
        ...

    def depth_step(self, xi: Float[Tensor, "n 7"], damping: float) -> Float[Tensor, "n p"] | None:
        """Change of the inverse depths after a step of the keyframes; none if it has none."""
        ...


@runtime_checkable
class GraphTerm(Protocol):
    """Residuals of keyframes' similarities."""

    def linearise(self, state: GraphState) -> LinearTerm:
        """At a state."""
        ...
