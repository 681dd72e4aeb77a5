"""Interface of the estimators of keyframe depths that the mapper uses."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor

from geogs.depth.depth_view import DenseDepth, DepthView, PosedDepth

Progress = Callable[[float], None]
"""Called with the finished fraction."""
Limits = tuple[float, float]
"""Nearest and farthest depth to search, map units."""


class DepthTask(NamedTuple):
    """A keyframe whose depth is searched."""

    view: DepthView
    neighbours: Sequence[DepthView]
    """Views that it is matched with, best first."""
    limits: Limits | None = None
    """Nearest and farthest depth to search; None for those of the tracker."""


def silent(fraction: float) -> None:
    """Report no progress."""


@runtime_checkable
class DepthEngine(Protocol):
    """The keyframe depth's heavy parts; tensors live on the engine's device."""

    def observe(self, view: DepthView) -> None:
        """Prepare the image of a view that others will be matched with."""
        ...

    def estimate(self, tasks: Sequence[DepthTask], progress: Progress = silent) -> list[DenseDepth]:
        """Estimate the dense depth of every task's keyframe (``estimate_depth``)."""
        ...

    def check(
        self, depths: Sequence[PosedDepth], others: Sequence[Sequence[PosedDepth]]
    ) -> list[DenseDepth]:
        """Repair, average and rate every depth by its others (``check_depth``).

        Normals stay as they are.
        """
        ...

    def keep(self, points: Float[Tensor, "n 3"], depths: Sequence[PosedDepth]) -> Bool[Tensor, "n"]:
        """Whether world points lie outside the free space of the depths (``vote``); points in
        front of their sky are in free space."""
        ...

    def photo_costs(
        self,
        view: DepthView,
        others: Sequence[DepthView],
        depths: Float[Tensor, "2 h w"],
        same: Bool[Tensor, "h w"],
        mask: Bool[Tensor, "h w"] | None = None,
    ) -> Float[Tensor, "2 h w"]:
        """Photometric costs of two depths of each pixel (``photo_costs``)."""
        ...

    def farther_surface(self, depth: Float[Tensor, "h w"], reach: int) -> Float[Tensor, "h w"]:
        """Depth of the farther surface beside each pixel, else 0 (``farther_surface``)."""
        ...


class AlternativeSearch:
    """A search of its own kind, with the checks, votes and costs of the ``classical`` engine."""

    def __init__(self, classical: DepthEngine) -> None:
        self.classical = classical
        self.keep = classical.keep
        self.photo_costs = classical.photo_costs
        self.farther_surface = classical.farther_surface

    def observe(self, view: DepthView) -> None:
        """As in the protocol."""
        self.classical.observe(view)

    def check(
        self, depths: Sequence[PosedDepth], others: Sequence[Sequence[PosedDepth]]
    ) -> list[DenseDepth]:
        """As in the protocol."""
        return self.classical.check(depths, others)
