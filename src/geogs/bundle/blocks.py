"""Unknowns beside poses and inverse depths that all edges share: what a block of them says.

To add unknowns to an adjustment, write such a block. It says how a projection depends on them,
which of them are variables and how they move; the elimination of the depths
(:mod:`geogs.bundle.linearise`) and the solver (:mod:`geogs.bundle.levenberg`) take it from there.
"""

from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.projection import Projection

B = TypeVar("B", bound="SharedBlock")


@dataclass(frozen=True)
class SharedProjection(Projection):
    """A projection with its first derivatives."""

    jacobian: Float[Tensor, "e c 2 p"]
    """d pixel / d (xi of the motion to the target, left perturbation; the block's unknowns)."""
    depth_jacobian: Float[Tensor, "e 2 p"]
    """d pixel / d inverse depth of the source."""


@runtime_checkable
class SharedBlock(Protocol):
    """Some unknowns at their present values, which never change in place."""

    @property
    def free(self) -> tuple[bool, ...]:
        """Of each unknown, whether it is a variable."""
        ...

    @property
    def largest_step(self) -> float:
        """By which an unknown moves at once."""
        ...

    def moved(self: B, step: Float[Tensor, "m"]) -> B:
        """After a step of all unknowns, zero for those that are no variables."""
        ...

    def project(
        self,
        T_cw: Float[Tensor, "n 4 4"],
        source: Int[Tensor, "e"],
        target: Int[Tensor, "e"],
        inverse_depth: Float[Tensor, "e p"],
    ) -> Projection:
        """Where the cells of the sources fall in the targets; depths are those of the sources."""
        ...

    def linearise(
        self,
        T_cw: Float[Tensor, "n 4 4"],
        source: Int[Tensor, "e"],
        target: Int[Tensor, "e"],
        inverse_depth: Float[Tensor, "e p"],
    ) -> SharedProjection:
        """:meth:`project` with its derivatives."""
        ...
