"""Short clips of random rooms with exact geometry: what the trainer gets."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from geogs_train.rooms.reference import FlowTruth
from geogs_train.rooms.render import flow
from geogs_train.rooms.scene import Solids
from geogs_train.rooms.views import Views


@dataclass(frozen=True)
class ClipBatch:
    """b clips of v views each; every clip is of another room."""

    images: Float[Tensor, "b v 3 h w"]
    """RGB in 0..1, in 8-bit steps, as a camera with noise, blur and artefacts takes them."""
    light: Float[Tensor, "b v 3 h w"]
    """The same as linear light, before the camera: what there is to see."""
    depth: Float[Tensor, "b v h w"]
    """z along the optical axis in metres, exact at the (integer) pixel centres."""
    normal: Float[Tensor, "b v 3 h w"]
    """Unit, camera frame, facing the camera, exact at the pixel centres."""
    T_cw: Float[Tensor, "b v 4 4"]
    """World to camera, OpenCV axes."""
    intrinsics: Float[Tensor, "b 4"]
    """fx fy cx cy in pixels, pixel centres at integers."""
    solids: Solids
    """What stands in the rooms; hides points from views."""

    @property
    def views(self) -> Views:
        """The cameras."""
        height, width = self.depth.shape[-2:]
        return Views(self.T_cw, self.intrinsics, width, height)

    def flow(self, first: int, second: int) -> FlowTruth:
        """Where the points that the view ``first`` sees are in the view ``second``."""
        return flow(self.solids, self.views, self.depth, first, second)
