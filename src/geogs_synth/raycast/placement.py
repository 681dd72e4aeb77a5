"""Solids in each camera's frame, and the pixels that may see them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int64

from geogs_synth.camera.radial_camera import RadialCamera
from geogs_synth.raycast.pixel_kernels import PlacedSolids
from geogs_synth.scene.textured_scene import Scene

_NEAR = 1e-3


@dataclass(frozen=True)
class PlacedScene:
    """The n solids of a scene before p cameras; ``q`` is p, or 1 where nothing moves."""

    scene: Scene
    T_wc: Float64[np.ndarray, "p 4 4"]
    rotation: Float64[np.ndarray, "q n 3 3"]
    """Local to world."""
    centre: Float64[np.ndarray, "q n 3"]

    def solids(self, camera: int) -> PlacedSolids:
        """All solids for one of the cameras."""
        s = self.scene
        return PlacedSolids(
            kind=s.solids.kind,
            half=s.solids.half,
            rotation=self.rotation[camera if len(self.rotation) > 1 else 0],
            origin=self._origin[camera],
            matrix=self._matrix[camera],
            texture=s.face_texture,
            shift=s.texture_shift,
            emission=s.emission,
        )

    def bounds(
        self, lens: RadialCamera, cameras: Int64[np.ndarray, "k"] | None = None, margin: float = 0.0
    ) -> Int64[np.ndarray, "k n 4"]:
        """Left, top, right, bottom (exclusive) of the pixels that may see each solid."""
        some = slice(None) if cameras is None else cameras
        T_wc = self.T_wc[some]
        still = len(self.rotation) == 1
        rotation = self.rotation if still else self.rotation[some]
        centre = self.centre if still else self.centre[some]
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
        corners = self.scene.solids.bounding_half[:, None] * signs
        world = np.einsum("qnij,nkj->qnki", rotation, corners) + centre[:, :, None]
        local = (world - T_wc[:, None, None, :3, 3]) @ T_wc[:, None, :3, :3]
        x, y, z = np.moveaxis(local, -1, 0)
        near = z < _NEAR
        plane = local[..., :2] / np.where(near, 1.0, z)[..., None]
        box = lens.pixel_boxes(plane.min(2), plane.max(2), margin)
        # A solid that crosses the camera's plane may be in any pixel, unless a side excludes it.
        box[near.any(2)] = [0, 0, lens.camera.width, lens.camera.height]
        left, top, right, bottom = lens.view
        for beyond in (near, x < left * z, x > right * z, y < top * z, y > bottom * z):
            box[beyond.all(2)] = 0
        return box

    @cached_property
    def _origin(self) -> Float64[np.ndarray, "p n 3"]:
        offset = self.T_wc[:, None, :3, 3] - self.centre
        to_local = np.broadcast_to(self.rotation.swapaxes(2, 3), (*offset.shape, 3))
        return np.einsum("pnij,pnj->pni", to_local, offset)

    @cached_property
    def _matrix(self) -> Float64[np.ndarray, "p n 3 3"]:
        return self.rotation.swapaxes(2, 3) @ self.T_wc[:, None, :3, :3]
