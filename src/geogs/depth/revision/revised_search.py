"""A search of which each depth is looked at once more."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

from geogs.depth.depth_engine import AlternativeSearch, Limits, Progress, silent
from geogs.depth.depth_view import DenseDepth, DepthView
from geogs.threads import thread_map


class RevisedSearch(AlternativeSearch, ABC):
    """Another engine's search, of which each depth is looked at once more by itself."""

    def estimate(
        self,
        references: Sequence[DepthView],
        neighbours: Sequence[Sequence[DepthView]],
        progress: Progress = silent,
        limits: Sequence[Limits | None] | None = None,
    ) -> list[DenseDepth]:
        """As in the protocol."""
        searched = self.classical.estimate(references, neighbours, progress, limits)
        tasks = list(zip(references, neighbours, searched, strict=True))
        return thread_map(lambda task: self.revised(*task), tasks)

    @abstractmethod
    def revised(
        self, view: DepthView, others: Sequence[DepthView], searched: DenseDepth
    ) -> DenseDepth:
        """What is made of the depth of a view that was matched with some others."""
