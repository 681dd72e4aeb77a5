"""A search of which each depth is looked at once more."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

from geogs.depth.depth_engine import AlternativeSearch, DepthTask, Progress, silent
from geogs.depth.depth_view import DenseDepth, DepthView
from geogs.threads import thread_map


class RevisedSearch(AlternativeSearch, ABC):
    """Another engine's search, of which each depth is looked at once more by itself."""

    def estimate(self, tasks: Sequence[DepthTask], progress: Progress = silent) -> list[DenseDepth]:
        """As in the protocol."""
        searched = self.classical.estimate(tasks, progress)

        def one(pair: tuple[DepthTask, DenseDepth]) -> DenseDepth:
            task, found = pair
            return self.revised(task.view, task.neighbours, found)

        return thread_map(one, list(zip(tasks, searched, strict=True)))

    @abstractmethod
    def revised(
        self, view: DepthView, others: Sequence[DepthView], searched: DenseDepth
    ) -> DenseDepth:
        """What is made of the depth of a view that was matched with some others."""
