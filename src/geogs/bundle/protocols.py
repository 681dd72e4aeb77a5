"""Interface of bundle adjustment solvers on either device."""

from dataclasses import dataclass, replace
from typing import Protocol, TypeVar, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from geogs.bundle.problem import Problem
from geogs.geometry.least_squares import Policy

P = TypeVar("P", bound=Problem, contravariant=True)


@dataclass(frozen=True)
class BundleOptions:
    """Options of the solution of a problem."""

    iterations: int = 2
    huber: float = 3.0
    """Huber threshold in standard deviations."""
    damping: float = 1e-4
    """Levenberg damping relative to the diagonal of the reduced system, at the start."""
    least_damping: float | None = None
    """None: all steps are accepted, with the same damping (Gauss-Newton). Else Levenberg-Marquardt:
    only steps that lower the cost are accepted, and damping falls tenfold with each, but no further
    than this; it rises with each other, and where the equations have no solution."""
    depth_damping: float = 1e-3
    """Damping of inverse depth relative to the mean curvature of its frame."""
    chunk: int = 24
    """Edges linearised at a time; bounds memory."""
    tolerance: float = 0.0
    """Change of the poses (units, radians) below which a step is the last one; the dense GPU solver
    only tests this where it computes the cost."""

    @property
    def lowers_cost(self) -> bool:
        """Whether only steps that lower the cost are accepted."""
        return self.least_damping is not None

    @property
    def policy(self) -> Policy:
        """Policy of the least-squares loop."""
        plain = Policy(self.iterations, self.damping, self.tolerance)
        if self.least_damping is None:
            return plain
        return replace(
            plain,
            max_trials=2 * self.iterations,
            max_damping=1.0,
            least_damping=self.least_damping,
            retries_unsolvable=True,
            stall=1e-6,  # the relative error of a cost, as pixels are float32
        )


@dataclass(frozen=True)
class BundleResult:
    """The adjusted problem."""

    T_cw: Float[Tensor, "n 4 4"]
    inverse_depth: Float[Tensor, "n p"]
    information: Float[Tensor, "n p"]
    """Sum over a frame's edges of w |dp/dd|^2 before the last step, plus the information of other
    measurements."""
    finite: bool


@runtime_checkable
class BundleSolver(Protocol[P]):
    """Solver of one kind of problem."""

    def solve(self, problem: P, options: BundleOptions) -> BundleResult:
        """Take ``options.iterations`` damped steps, or fewer (``tolerance``, ``least_damping``).

        A non-finite step is not taken; if the last one was not finite, ``finite`` is False in the
        result.
        """
        ...
