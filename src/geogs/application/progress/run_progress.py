"""How a run tells what it is doing, to nobody unless somebody wants to know."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from geogs.pose_estimate import PoseEstimate


class RunProgress:
    """Follows a run from outside; this one shows nothing. Override what you want to see."""

    def write(self, text: str) -> None:
        """A sentence for the user; nothing if it is empty."""

    def expect(self, frames: int | None) -> None:
        """Called before the first of so many frames, if known."""

    def frame(self, status: "PoseEstimate") -> None:
        """Called after each frame."""

    def dropped(self, frames: int) -> None:
        """Called when more frames of a live source came too fast to be used; so many so far."""

    def stage(self, name: str, fraction: float) -> None:
        """Called after each part of another stage; ``fraction`` in [0, 1]."""
