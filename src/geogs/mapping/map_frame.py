"""Internal frame and unit of a map whose world frame and unit are given."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.limits import Positive
from geogs.types import MapSnapshot

# Most cameras whose distances make the unit.
_SAMPLED_CAMERAS = 8


@dataclass(frozen=True)
class MapFrame:
    """Map coordinates are (world - origin) / unit; axes are the same.

    This keeps the float32 precision of disks, and lets the renderer use a fixed near plane,
    whatever the origin and the unit of the poses.
    """

    origin: Float64[np.ndarray, "3"]
    """World coordinates of the map's origin."""
    unit: Positive
    """Length of a map unit in the world."""

    @staticmethod
    def around(
        points: Float64[np.ndarray, "n 3"], poses: Sequence[Float[Tensor, "4 4"]]
    ) -> "MapFrame":
        """The frame in which the median distance of the scene's points from the cameras is 1."""
        origin = np.median(points, axis=0)
        some = poses[:: 1 + len(poses) // _SAMPLED_CAMERAS]
        centres = np.stack([-(T[:3, :3].T @ T[:3, 3]).numpy() for T in some])
        distance = np.linalg.norm(points[:, None] - centres, axis=2)
        return MapFrame(origin, float(np.median(distance)))

    def pose(self, T_cw: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
        """Map to camera, both in map units."""
        moved = T_cw.clone()
        origin = torch.from_numpy(self.origin).to(T_cw)
        moved[:3, 3] = (T_cw[:3, 3] + T_cw[:3, :3] @ origin) / self.unit
        return moved

    def points(self, world: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """World points in map coordinates."""
        return (world - self.origin) / self.unit

    def world_snapshot(self, disks: MapSnapshot) -> MapSnapshot:
        """Disks of the map in world coordinates and units."""
        return disks.in_world(self.origin, self.unit)

    def map_snapshot(self, disks: MapSnapshot) -> MapSnapshot:
        """Disks in world coordinates and units in those of the map."""
        origin = torch.from_numpy(self.origin).to(disks.position)
        position = (disks.position - origin) / self.unit
        return replace(disks, position=position, scale=disks.scale / self.unit)


WORLD = MapFrame(np.zeros(3), 1.0)
"""The world's own frame and unit."""
