"""Source of a result: the run or the reconstruction that made the map."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from geogs.reconstruction import Reconstruction
    from geogs.slam import Slam

    MappedScene = Slam | Reconstruction
