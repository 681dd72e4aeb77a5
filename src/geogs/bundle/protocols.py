"""What the tracker asks of whatever adjusts, on either device."""

from dataclasses import dataclass, replace
from typing import Protocol, TypeVar, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from geogs.bundle.problem import Problem
from geogs.geometry.least_squares import Policy

P = TypeVar("P", bound=Problem, contravariant=True)

MAX_DAMPING = 1.0
"""Most that a step of Levenberg and Marquardt's is damped by, relative to the diagonal."""
TRIALS = 2
"""Steps that are tried for each that may be taken."""
COST_ROUNDING = 1e-6
"""Relative error of a cost, as pixels are float32: a step that seems to raise it by less says that
there is nothing left to gain."""


@dataclass(frozen=True)
class BundleOptions:
    """How a problem is solved."""

    iterations: int = 2
    huber: float = 3.0
    """Standard deviations beyond which a residual counts linearly."""
    damping: float = 1e-4
    """Levenberg damping relative to the diagonal of the reduced system, at the start."""
    least_damping: float | None = None
    """None: all steps are taken, damped alike (Gauss and Newton). Else Levenberg and Marquardt's
    method: only steps that lower the cost are taken, and damping falls tenfold with each, but no
    further than this; with each other, and where the equations have no solution, it rises."""
    depth_damping: float = 1e-3
    """Damping of inverse depth relative to the mean curvature of its frame."""
    chunk: int = 24
    """Edges linearised at a time; bounds memory."""
    tolerance: float = 0.0
    """A step that moves no pose by this much (units, radians) is the last one; the dense solver of
    a GPU waits for that only where it waits for the cost."""

    @property
    def lowers_cost(self) -> bool:
        """Whether only steps that lower the cost are taken."""
        return self.least_damping is not None

    @property
    def policy(self) -> Policy:
        """The policy of the least-squares loop."""
        plain = Policy(self.iterations, self.damping, self.tolerance)
        if self.least_damping is None:
            return plain
        return replace(
            plain,
            max_trials=TRIALS * self.iterations,
            max_damping=MAX_DAMPING,
            least_damping=self.least_damping,
            retries_unsolvable=True,
            stall=COST_ROUNDING,
        )


@dataclass(frozen=True)
class BundleResult:
    """The adjusted problem."""

    T_cw: Float[Tensor, "n 4 4"]
    inverse_depth: Float[Tensor, "n p"]
    information: Float[Tensor, "n p"]
    """Sum over a frame's edges of w |dp/dd|^2 before the last step, and the information of what was
    measured beside the matches."""
    finite: bool


@runtime_checkable
class BundleSolver(Protocol[P]):
    """What adjusts one kind of problem."""

    def solve(self, problem: P, options: BundleOptions) -> BundleResult:
        """Take ``options.iterations`` damped steps, or fewer (``tolerance``, ``least_damping``).

        A step that is not finite is not taken; where the last one was not, ``finite`` is False in
        the result.
        """
        ...
