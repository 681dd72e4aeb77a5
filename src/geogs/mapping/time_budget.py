"""Division of the time for a reconstruction from known poses, and the number of images that fit."""

import time
from dataclasses import dataclass

import numpy as np

from geogs.config import SearchConfig

# Ratio of the time to check depths and grow disks to that of one search of the depths.
_GROWING = 0.6

# Images to read for each that gets a depth, up to a total.
_HELPERS, _FEW = 4, 100
# Fraction of the time left for reading images that get no depth.
_HELP = 0.05


@dataclass(frozen=True)
class ViewCost:
    """Seconds for an image."""

    reading: float
    """To read it."""
    search: float
    """To search its depth once."""
    output: float
    """To put it into the mesh and the files."""


def rounds(search: SearchConfig) -> float:
    """Ratio of the time before the training, with checks and growth, to that of one search."""
    return _GROWING + (2.0 if search.repeat else 1.0)


def affordable_views(
    seconds: float, cost: ViewCost, search: SearchConfig, searched: int = 0, read: int = 0
) -> int:
    """Number of images that can be prepared in the fraction ``search.depth_ratio`` of the time.

    That is the time left without that for their mesh and files.

    Args:
        seconds: time left, less the fixed time for mesh and files.
        cost: seconds for an image.
        search: whether depths are searched twice, and the fraction.
        searched: images whose depth has been searched once by now.
        read: images that have been read by now.
    """
    paid = cost.reading * read + cost.search * searched
    a_view = cost.reading + rounds(search) * cost.search + search.depth_ratio * cost.output
    return max(int((search.depth_ratio * seconds + paid) / max(a_view, 1e-9)), 0)


def helpers(views: int, seconds: float, cost: ViewCost) -> int:
    """Number of images to read beyond those that get a depth, to match these with.

    Args:
        views: number of images that get a depth.
        seconds: time left.
        cost: seconds for an image.
    """
    few = max(min(_HELPERS * views, _FEW) - views, 0)
    return min(few, max(int(_HELP * seconds / max(cost.reading, 1e-9)), 0))


@dataclass(frozen=True)
class OutputCost:
    """Seconds for the mesh and the files."""

    once: float
    """Fixed part, whatever the number of images."""
    a_view: float
    """For each image of the map."""

    def of(self, views: int) -> float:
        """Seconds for ``views`` images."""
        return self.once + views * self.a_view


class TimeBudget:
    """A time limit, or none, for a reconstruction that begins now."""

    def __init__(self, seconds: float | None, output_ratio: float) -> None:
        self._deadline = None if seconds is None else time.perf_counter() + seconds
        self._read: list[float] = []
        self.views = 0
        """Number of images of the map, once that is decided."""
        self.output_cost = OutputCost(output_ratio * (seconds or 0.0), 0.0)
        """Time after the training: a fraction of the budget until it is known."""

    @property
    def left(self) -> float:
        """Seconds until the limit."""
        return np.inf if self._deadline is None else self._deadline - time.perf_counter()

    @property
    def training_end(self) -> float | None:
        """Time at which training has to end, in ``time.perf_counter``'s seconds."""
        if self._deadline is None:
            return None
        return self._deadline - self.output_cost.of(self.views or len(self._read))

    def count_image(self) -> None:
        """Count an image that has been read."""
        self._read.append(time.perf_counter())

    def count_spent(self, seconds: float) -> None:
        """Subtract seconds spent before."""
        if self._deadline is not None:
            self._deadline -= seconds

    def further_views(self, search: SearchConfig, searched: int, seconds: float) -> int:
        """Number of further images to read, given how many were searched, and seconds for each.

        As many as time allows; where these are few, and perhaps far from each other, some more only
        to match them with.
        """
        read = self._read
        reading = (read[-1] - read[0]) / max(len(read) - 1, 1)
        cost = ViewCost(reading, seconds, self.output_cost.a_view)
        left = self.left - self.output_cost.once
        self.views = max(affordable_views(left, cost, search, searched, len(read)), searched)
        return max(self.views + helpers(self.views, left, cost) - len(read), 0)
