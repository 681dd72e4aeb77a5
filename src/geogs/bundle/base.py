"""What the tracker asks of an adjustment, on whatever device."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from geogs.bundle.problem import BundleProblem


@dataclass(frozen=True)
class BundleOptions:
    """How a problem is solved."""

    iterations: int = 2
    huber: float = 3.0
    """Standard deviations beyond which a residual counts linearly."""
    damping: float = 1e-4
    """Levenberg damping relative to the diagonal of the reduced system."""
    depth_damping: float = 1e-3
    """Damping of inverse depth relative to the mean curvature of its frame."""
    chunk: int = 24
    """Edges linearised at a time; bounds memory."""
    min_inverse_depth: float = 1e-3
    max_inverse_depth: float = 1e2
    tolerance: float = 0.0
    """On the CPU, a step that moves no pose by this much (units, radians) is the last one."""


@dataclass(frozen=True)
class BundleResult:
    """The adjusted problem."""

    T_cw: Float[Tensor, "n 4 4"]
    inverse_depth: Float[Tensor, "n p"]
    information: Float[Tensor, "n p"]
    """Sum over a frame's edges of w |dp/dd|^2 before the last step."""
    residual: Float[Tensor, "e"]
    """Root of the robustly weighted mean squared residual of each edge in pixels."""
    finite: bool


@runtime_checkable
class BundleSolver(Protocol):
    """What adjusts a problem."""

    def solve(self, problem: BundleProblem, options: BundleOptions | None = None) -> BundleResult:
        """Take ``options.iterations`` damped Gauss-Newton steps.

        A step that is not finite is not taken, and ``finite`` is False in the result.
        """
        ...
