"""Interface for progress reports of a run."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from geogs.pose_estimate import PoseEstimate


class RunProgress:
    """Receives progress reports of a run; this one shows nothing. Override its methods."""

    def write(self, text: str) -> None:
        """Show a sentence to the user; nothing if it is empty."""

    def stages(self, names: Sequence[str]) -> None:
        """Called at the start with the names of the stages to come, where they are known."""

    def expect(self, frames: int | None) -> None:
        """Called before the first frame, with the number of frames if known."""

    def frame(self, status: "PoseEstimate") -> None:
        """Called after each frame."""

    def dropped(self, frames: int) -> None:
        """Called when frames of a live source were dropped, with their number so far."""

    def stage(self, name: str, fraction: float) -> None:
        """Called after each part of another stage; ``fraction`` in [0, 1]."""
