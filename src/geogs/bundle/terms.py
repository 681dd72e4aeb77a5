"""The terms of an adjustment: what a kind of measurement says of the unknowns.

To add a kind of measurement, write a term in a file of its own and enter it where the problem is
made (``FrameGraph.streamed_problem``). A ``DepthTerm`` says something of the inverse depths of a
frame, and maybe of poses or shared unknowns along with them; a ``PoseTerm`` of poses and shared
unknowns alone. Dense flow, which every problem has, is :mod:`geogs.bundle.flow_term`; shared
unknowns, such as a lens, come with a ``SharedBlock``.

Both sides: the CPU's solvers take any term. The GPU's have kernels for what is best done there
(:mod:`geogs.bundle.cuda.depth_terms`) and take what other terms say of depths or of poses alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.hyper_edge import HyperEdge

B = TypeVar("B", bound="SharedBlock")


@dataclass(frozen=True)
class BundleState:
    """What is adjusted, at its present values."""

    T_cw: Float[Tensor, "n 4 4"]
    """World to camera of each frame, float64."""
    inverse_depth: Float[Tensor, "n p"]
    block: "SharedBlock | None" = None


@runtime_checkable
class DepthTerm(Protocol):
    """Residuals of the inverse depths of single frames."""

    @property
    def information(self) -> Float[Tensor, "n p"] | None:
        """Inverse variances of what it measures on its own, if it does."""
        ...

    def of_frame(self, frame: int, state: BundleState) -> HyperEdge:
        """The residuals of a frame linearised, with equations of its depths."""
        ...

    def cost(self, state: BundleState) -> float:
        """Twice what is minimised of all frames: their squared residuals, as far as they count."""
        ...


@runtime_checkable
class PoseTerm(Protocol):
    """Residuals of poses, beside any depth; all of it is on the CPU."""

    @property
    def source(self) -> Int[Tensor, "m"]:
        """With ``target``: which frames it joins."""
        ...

    @property
    def target(self) -> Int[Tensor, "m"]:
        """With ``source``: which frames it joins."""
        ...

    def hyper_edges(self, state: BundleState) -> Sequence[HyperEdge]:
        """The residuals linearised."""
        ...

    def cost(self, state: BundleState) -> float:
        """Twice what is minimised: the squared residuals, as far as they count."""
        ...


@runtime_checkable
class SharedBlock(Protocol):
    """Unknowns that a whole problem shares, at their present values; never changed in place."""

    @property
    def free(self) -> Sequence[bool]:
        """Whether each unknown is a variable."""
        ...

    @property
    def largest_step(self) -> float:
        """By which an unknown moves at once."""
        ...

    def moved(self: B, step: Float[Tensor, "m"]) -> B:
        """After a step of all unknowns, zero for those that are no variables."""
        ...
