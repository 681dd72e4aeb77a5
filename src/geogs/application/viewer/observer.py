"""Who looks on while a run goes on."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from geogs.types import Frame

if TYPE_CHECKING:
    from geogs.application.results.result import Result
    from geogs.pose_estimate import PoseEstimate
    from geogs.slam import Slam


class RunObserver:
    """Looks on and changes nothing; this one does not even look. Override what you want to see.

    The run waits for each of these calls, so they should be quick: take what is needed, and do the
    work elsewhere.
    """

    def frame(self, frame: Frame, status: "PoseEstimate", slam: "Slam") -> None:
        """Called after each frame."""

    def result(self, result: "Result") -> None:
        """Called after all files have been written."""


class Observers(RunObserver):
    """Several who look on, one after the other."""

    def __init__(self, several: Sequence[RunObserver]) -> None:
        self._several = several

    def frame(self, frame: Frame, status: "PoseEstimate", slam: "Slam") -> None:
        """Tell each of them."""
        for observer in self._several:
            observer.frame(frame, status, slam)

    def result(self, result: "Result") -> None:
        """Tell each of them."""
        for observer in self._several:
            observer.result(result)
