"""Short clips of random rooms with exact geometry: the trainer's input."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from geogs_synth.camera.camera_batch import CameraBatch, pixel_grid, project, rays
from geogs_synth.clips.dynamics import Dynamics
from geogs_synth.raycast.caster_choice import caster_for
from geogs_synth.raycast.rendered_rooms import FlowTruth
from geogs_synth.scene.solids import SolidBatch


@dataclass(frozen=True)
class ClipBatch:
    """b clips of v views each; every clip is of another room."""

    images: Float[Tensor, "b v 3 h w"]
    """RGB in 0..1, in 8-bit steps, as a camera with noise, blur and artefacts takes them."""
    light: Float[Tensor, "b v 3 h w"]
    """The same scene as linear light, before the camera."""
    depth: Float[Tensor, "b v h w"]
    """z along the optical axis in metres, exact at the (integer) pixel centres."""
    normal: Float[Tensor, "b v 3 h w"]
    """Unit, camera frame, facing the camera, exact at the pixel centres."""
    solid: Int[Tensor, "b v h w"]
    """Index of the solid that each pixel shows; -1 for the room itself."""
    views: CameraBatch
    solids: SolidBatch
    """Solids of the rooms at the time of the first view; they hide points from views."""
    dynamics: Dynamics | None = None
    """Motion and kinds of the scenes; None where all are usual."""

    def flow(self, first: int, second: int) -> FlowTruth:
        """Pixels in the view ``second`` of the points that the view ``first`` sees."""
        points = self.points(first)
        solids = self.solids
        if self.dynamics is not None:
            points = points + (second - first) * self.dynamics.velocity_of(self.solid[:, first])
            solids = solids.moved_by(self.dynamics.velocity, second)
        return caster_for(points.device).flow(solids, self.views, points, second)

    def still_flow(self, points: Float[Tensor, "b h w 3"], second: int) -> Float[Tensor, "b h w 2"]:
        """Pixels of these points in the view ``second`` if only the camera moved."""
        pixels, _ = project(self.views, second, points.flatten(1, 2))
        return pixels.unflatten(1, points.shape[1:3])

    def points(self, view: int) -> Float[Tensor, "b h w 3"]:
        """Points that the pixels of a view see, world frame."""
        depth = self.depth[:, view]
        origin, direction = rays(self.views, view, *pixel_grid(self.views))
        return (origin + depth.flatten(1)[..., None] * direction).unflatten(1, depth.shape[1:])
