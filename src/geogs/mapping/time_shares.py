"""How the time for a reconstruction from known poses is divided: how many images it lasts for."""

from dataclasses import dataclass

from geogs.config import SearchConfig

# What checking depths and growing disks take, as a part of one search of the depths.
_GROWING = 0.4


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

    The part is ``search.depth_share`` of what is left when the mesh and the files of that many
    images have been paid for.

    Args:
        seconds: left, but for what mesh and files cost however many images there are.
        cost: of an image.
        search: whether depths are searched twice, and the part.
        searched: images whose depth has been searched once by now.
        read: images that have been read by now.
    """
    paid = cost.reading * read + cost.search * searched
    a_view = cost.reading + rounds(search) * cost.search + search.depth_share * cost.output
    return max(int((search.depth_share * seconds + paid) / max(a_view, 1e-9)), 0)
