"""How the time for a reconstruction from known poses is divided: how many images it lasts for."""

import time
from dataclasses import dataclass

import numpy as np

from geogs.config import SearchConfig

# What checking depths and growing disks take, as a part of one search of the depths.
_GROWING = 0.6

# Images for each that is to get a depth, where these are few, and how many are not few.
_HELPERS, _FEW = 4, 100
# Part of the time that is left which reading such helpers may take.
_HELP = 0.05


@dataclass(frozen=True)
class ViewCost:
    """What an image costs, seconds."""

    reading: float
    """Until it is there to be matched with."""
    search: float
    """One search of its depth."""
    output: float
    """In the mesh and the files."""


def rounds(search: SearchConfig) -> float:
    """Searches of the depths that are to be paid for, what they are made of after it included."""
    return _GROWING + (2.0 if search.repeat else 1.0)


def affordable_views(
    seconds: float, cost: ViewCost, search: SearchConfig, searched: int = 0, read: int = 0
) -> int:
    """How many images a time lasts for, so that what they cost before the training is a part of it.

    The part is ``search.depth_ratio`` of what is left when the mesh and the files of that many
    images have been paid for.

    Args:
        seconds: left, but for what mesh and files cost however many images there are.
        cost: of an image.
        search: whether depths are searched twice, and the part.
        searched: images whose depth has been searched once by now.
        read: images that have been read by now.
    """
    paid = cost.reading * read + cost.search * searched
    a_view = cost.reading + rounds(search) * cost.search + search.depth_ratio * cost.output
    return max(int((search.depth_ratio * seconds + paid) / max(a_view, 1e-9)), 0)


def helpers(views: int, seconds: float, cost: ViewCost) -> int:
    """How many more images to read than get a depth, so that there are some to match these with.

    Args:
        views: that get a depth.
        seconds: left.
        cost: of an image.
    """
    few = max(min(_HELPERS * views, _FEW) - views, 0)
    return min(few, max(int(_HELP * seconds / max(cost.reading, 1e-9)), 0))


@dataclass(frozen=True)
class OutputCost:
    """What the mesh and the files are going to take, seconds."""

    once: float
    """However many images make the map."""
    a_view: float
    """For each of them."""

    def of(self, views: int) -> float:
        """Seconds for so many images."""
        return self.once + views * self.a_view


class TimeBudget:
    """Seconds for a reconstruction, counted from now on; without a limit there is no end."""

    def __init__(self, seconds: float | None, output_ratio: float) -> None:
        self._deadline = None if seconds is None else time.perf_counter() + seconds
        self._read: list[float] = []
        self.views = 0
        """Images that make the map, once that is decided."""
        self.output_cost = OutputCost(output_ratio * (seconds or 0.0), 0.0)
        """What comes after the training: a part of the budget until somebody knows better."""

    @property
    def left(self) -> float:
        """Seconds for all that is still to be done."""
        return np.inf if self._deadline is None else self._deadline - time.perf_counter()

    @property
    def training_end(self) -> float | None:
        """When training must have ended for what comes after it."""
        if self._deadline is None:
            return None
        return self._deadline - self.output_cost.of(self.views or len(self._read))

    def count_image(self) -> None:
        """An image has been read."""
        self._read.append(time.perf_counter())

    def count_spent(self, seconds: float) -> None:
        """So many seconds were spent before."""
        if self._deadline is not None:
            self._deadline -= seconds

    def further_views(self, search: SearchConfig, searched: int, seconds: float) -> int:
        """How many more images to read, of which some have been searched already in so many seconds
        each.

        As many as the time lasts for; where these are few, so that none may stand next to another,
        some that only help to find the depths of these.
        """
        read = self._read
        reading = (read[-1] - read[0]) / max(len(read) - 1, 1)
        cost = ViewCost(reading, seconds, self.output_cost.a_view)
        left = self.left - self.output_cost.once
        self.views = max(affordable_views(left, cost, search, searched, len(read)), searched)
        return max(self.views + helpers(self.views, left, cost) - len(read), 0)
