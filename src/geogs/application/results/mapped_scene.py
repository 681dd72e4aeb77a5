"""What a result is written of: a run or a reconstruction, whichever made the map."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from geogs.reconstruction import Reconstruction
    from geogs.slam import Slam

    MappedScene = Slam | Reconstruction
