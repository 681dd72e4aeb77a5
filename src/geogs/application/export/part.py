"""The exported part of a result: all of it, or what lies inside a region."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from geogs.application.export.originals import open_originals
from geogs.application.export.region import Region
from geogs.application.results.saved_result import SavedResult
from geogs.application.results.upright import tracked_poses
from geogs.errors import InputError
from geogs.io.sources.frame_source import Source
from geogs.mesh.clean import keep_faces
from geogs.mesh.triangle_mesh import Mesh
from geogs.types import MapSnapshot


@dataclass(frozen=True)
class Part:
    """A result in the axes of an export, with the region to keep."""

    result: SavedResult
    region: Region | None
    """All is kept where there is none."""
    axes: Float[np.ndarray, "3 3"]
    """Rows right, forward and up of the result's world."""
    images: tuple[str, ...] = ()
    """The source of the run, if its images are exported at full size."""

    @property
    def originals(self) -> Source | None:
        """The images at full size, if they are exported. Raises InputError as of opening them."""
        return open_originals(self.result, self.images) if self.images else None

    def holds(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Which points are kept. Raises InputError if none is."""
        if self.region is None:
            return np.ones(len(points), bool)
        cameras = tracked_poses(self.result.trajectory)[:, :3, 3]
        kept = self.region.holds(points, self.axes, cameras)
        if not kept.any():
            raise InputError("Nothing of the surface lies inside --crop; give a larger one.")
        return kept

    @cached_property
    def mesh(self) -> Mesh:
        """The mesh that is kept. Raises InputError if there is none."""
        mesh = self.result.mesh
        if mesh is None:
            folder = self.result.folder
            raise InputError(f"{folder} has no mesh.ply; geogs mesh {folder} makes it.")
        if self.region is None:
            return mesh
        return keep_faces(mesh, self.holds(mesh.vertices)[mesh.faces].all(1))

    @cached_property
    def disks(self) -> MapSnapshot:
        """The disks that are kept."""
        disks = self.result.disks
        kept = self.holds(disks.position.cpu().numpy())
        return replace(disks, **{name: getattr(disks, name)[kept] for name in disks.__slots__})
