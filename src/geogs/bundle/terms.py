"""Terms of an adjustment: one for each kind of measurement.

To add a kind of measurement, write a term in a file of its own and add it where the problem is made
(``FrameGraph.streamed_problem``). A ``DepthTerm`` constrains single inverse depths, a ``PoseTerm``
poses. Dense flow, which every problem has, is :mod:`geogs.bundle.flow_term`.

CPU solvers accept any term; GPU solvers any pose term, and the depth terms for which they have a
kernel (:mod:`geogs.bundle.cuda.depth_terms`).
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
    """Present values of the unknowns."""

    T_cw: Float[Tensor, "n 4 4"]
    """World to camera of each frame, float64."""
    inverse_depth: Float[Tensor, "n p"]
    block: LensBlock | None = None
    """The lens, if it is adjusted, too."""


@runtime_checkable
class DepthTerm(Protocol):
    """Residuals of the inverse depths of single frames."""

    @property
    def information(self) -> Float[Tensor, "n p"] | None:
        """Inverse variances of its own measurements, if any."""
        ...

    def of_frame(self, frame: int, state: BundleState) -> DepthEquations:
        """Linearise the residuals of a frame."""
        ...

    def cost(self, state: BundleState) -> float:
        """Return the cost of all frames (twice the objective): robust squared residuals."""
        ...


@runtime_checkable
class PoseTerm(Protocol):
    """Residuals of poses, without depths; always on the CPU."""

    @property
    def source(self) -> Int[Tensor, "m"]:
        """Source frame of each residual."""
        ...

    @property
    def target(self) -> Int[Tensor, "m"]:
        """Target frame of each residual."""
        ...

    def hyper_edges(self, state: BundleState) -> Sequence[HyperEdge]:
        """Linearise the residuals."""
        ...

    def cost(self, state: BundleState) -> float:
        """Return the cost (twice the objective): robust squared residuals."""
        ...
