"""How the time for a reconstruction from known poses is divided: how many images it lasts for."""

from dataclasses import dataclass

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
