"""Observers of a run."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from geogs.types import Frame

if TYPE_CHECKING:
    from geogs.application.results.result import Result
    from geogs.pose_estimate import PoseEstimate
    from geogs.slam import Slam


class RunObserver:
    """Observes a run without changing it; this one does nothing. Override its methods.

    The run waits for each of these calls, so they should be quick: copy the data, and do the work
    elsewhere.
    """

    def frame(self, frame: Frame, status: "PoseEstimate", slam: "Slam") -> None:
        """Called after each frame."""

    def result(self, result: "Result") -> None:
        """Called after all files have been written."""


class Observers(RunObserver):
    """Several observers, called one after the other."""

    def __init__(self, several: Sequence[RunObserver]) -> None:
        self._several = several

    def frame(self, frame: Frame, status: "PoseEstimate", slam: "Slam") -> None:
        """Forward the call to each observer."""
        for observer in self._several:
            observer.frame(frame, status, slam)

    def result(self, result: "Result") -> None:
        """Forward the call to each observer."""
        for observer in self._several:
            observer.result(result)
