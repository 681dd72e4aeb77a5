"""What the tracker asks of whatever adjusts, on either device."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from geogs.bundle.problem import MotionProblem, Problem
from geogs.bundle.terms import SharedBlock
from geogs.geometry.least_squares import Policy
from geogs.world.keyframes import Keyframe

P = TypeVar("P", bound=Problem, contravariant=True)

MAX_DAMPING = 1.0
"""Most that a step of Levenberg and Marquardt's is damped by, relative to the diagonal."""
TRIALS = 2
"""Steps that are tried for each that may be taken."""
COST_ROUNDING = 1e-6
"""By this part of itself a cost may be off, as pixels are float32: a step that seems to raise it by
less says that there is nothing left to gain."""


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
    min_inverse_depth: float = 1e-3
    max_inverse_depth: float = 1e2
    tolerance: float = 0.0
    """A step that moves no pose by this much (units, radians) is the last one; the dense solver of
    a GPU waits for that only where it waits for the cost."""

    @property
    def lowers_cost(self) -> bool:
        """Whether only steps that lower the cost are taken."""
        return self.least_damping is not None

    @property
    def policy(self) -> Policy:
        """The steps as the least-squares loop is told them."""
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
    residual: Float[Tensor, "e"]
    """Root of the robustly weighted mean squared residual of each edge in pixels."""
    finite: bool
    block: SharedBlock | None = None
    """The shared unknowns of a problem that has some."""


@runtime_checkable
class BundleSolver(Protocol[P]):
    """What adjusts one kind of problem."""

    def solve(self, problem: P, options: BundleOptions) -> BundleResult:
        """Take ``options.iterations`` damped steps, or fewer (``tolerance``, ``least_damping``).

        A step that is not finite is not taken; where the last one was not, ``finite`` is False in
        the result.
        """
        ...


@runtime_checkable
class MotionSolver(Protocol):
    """What finds the poses of frames seen from keyframes that stay as they are."""

    def solve(
        self, problem: MotionProblem, iterations: int = 4, huber: float = 3.0
    ) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "e p 2"]]:
        """Poses, each adjusted on its own, and the residuals of the edges at those poses."""
        ...

    def fit(
        self,
        T_guess: Float[Tensor, "4 4"],
        keyframe: Keyframe,
        pixels: Float[Tensor, "p 2"],
        weight: Float[Tensor, "p 2"],
        iterations: int,
        huber: float,
        limit: float,
    ) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "4 4"], Float[Tensor, "7"]]:
        """Pose of a frame against one keyframe, and what says whether it is right.

        Cells without information do not count. Returns the pose; the motion from the keyframe to
        it; and in one tensor the fraction of the cells that are matched, that whose residual is
        below ``limit`` pixels, the medians over the matched of the residual, of the motion and of
        its parallax (the motion from where the camera's rotation alone takes a cell), in pixels,
        which are not numbers where nothing is matched, the fraction of the cells that have
        information, and of those that are matched and have known depth
        (``Keyframe.has_known_depth``). On a GPU all stays there, and nothing waits.
        """
        ...


@runtime_checkable
class GridFields(Protocol):
    """What works on fields over the cells of a grid."""

    def fill(
        self, values: Float[Tensor, "*n p"], confidence: Float[Tensor, "*n p"]
    ) -> Float[Tensor, "*n p"]:
        """Values where confidence is positive; elsewhere the mean of their surroundings.

        Push and pull: confidence-weighted means over growing blocks, taken from the finest level
        that has any confidence near. Without any confidence the plain mean of a field is returned.
        """
        ...

    def transfer(
        self,
        T_ji: Float[Tensor, "4 4"],
        inverse_depth: Float[Tensor, "p"],
        information: Float[Tensor, "p"],
    ) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"]]:
        """Inverse depth and information of frame i as seen from frame j; nearest surface wins.

        Cells that nothing falls on are filled from their surroundings and have no information.
        """
        ...

    def reproject(
        self, keyframes: Sequence[Keyframe], T_cw: Sequence[Float[Tensor, "4 4"]]
    ) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]:
        """Cells of each keyframe in a frame at ``T_cw``, and cells of that frame in the keyframe.

        The frame has no depth of its own; it borrows the keyframe's.
        """
        ...


@runtime_checkable
class KeyframePairs(Protocol):
    """Directed pairs of keyframes, by their present poses and inverse depths."""

    def project(self) -> Float[Tensor, "e p 2"]:
        """Where the cells of the sources fall in the targets."""
        ...

    def moved(
        self, before: Float[Tensor, "e p 2"], weight: Float[Tensor, "e p 2"]
    ) -> Float[Tensor, "e"]:
        """Median distance in pixels of the matched cells from where they fell before."""
        ...

    def distances(self, rotation_weight: float, step: int = 2) -> Float[Tensor, "e"]:
        """DROID-SLAM's distance in pixels; infinite at little overlap.

        Mean of the flow (weight ``rotation_weight``) and of the flow without the rotation (the
        rest) over every ``step``-th of the cells that stay in front of the target; infinite where
        less than 3/4 do or where less than a fifth falls into the image.
        """
        ...
