"""Colours for the disks, which have none of their own."""

from collections.abc import Sequence

import numpy as np

from geogs.mesh.colour import colour_mesh
from geogs.mesh.types import DepthMapView, Mesh
from geogs.types import MapSnapshot


def splat_colours(disks: MapSnapshot, views: Sequence[DepthMapView]) -> np.ndarray:
    """RGB in [0, 1] of every disk, from the images that see it; the map itself has no colour."""
    points = Mesh(
        disks.position.cpu().numpy(), np.zeros((0, 3), np.int32), disks.normal.cpu().numpy()
    )
    tolerance = 4 * float(disks.scale.median())
    colours = colour_mesh(points, views, tolerance).colours
    return np.full((len(disks), 3), 0.5) if colours is None else colours / 255.0
