"""The terms of an adjustment: what a kind of measurement says of the unknowns.

To add a kind of measurement, write a term in a file of its own and enter it where the problem is
made (``FrameGraph.streamed_problem``). A ``DepthTerm`` says something of single inverse depths, a
``PoseTerm`` of poses. Dense flow, which every problem has, is :mod:`geogs.bundle.flow_term`.

The CPU's solvers take any term; the GPU's any term of poses, and those of depths that they have a
kernel for (:mod:`geogs.bundle.cuda.depth_terms`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.hyper_edge import DepthEquations, HyperEdge
from geogs.bundle.lens import LensBlock


@dataclass(frozen=True)
class BundleState:
    """What is adjusted, at its present values."""

    T_cw: Float[Tensor, "n 4 4"]
    """World to camera of each frame, float64."""
    inverse_depth: Float[Tensor, "n p"]
    block: LensBlock | None = None
    """The lens, where it is adjusted along with them."""


@runtime_checkable
class DepthTerm(Protocol):
    """Residuals of the inverse depths of single frames."""

    @property
    def information(self) -> Float[Tensor, "n p"] | None:
        """Inverse variances of what it measures on its own, if it does."""
        ...

    def of_frame(self, frame: int, state: BundleState) -> DepthEquations:
        """The residuals of a frame linearised."""
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
