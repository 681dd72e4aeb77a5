"""Settings of the surface."""

from dataclasses import dataclass
from typing import Annotated

from geogs.config.setting import Basic, CountOrZero, Positive, Range, Settings


@dataclass(frozen=True)
class MeshConfig(Settings, group="mesh"):
    """Surface extraction."""

    voxel: Annotated[float | None, Range(1e-6, 1e6)] = None
    """Voxel size in map units, larger in a far background; chosen from depth, budget and memory
    limit if none is given."""
    truncation: Annotated[float, Range(2, 16)] = 4.0
    """Voxels in front of and behind a surface in which distances are averaged."""
    min_weight: Positive = 1.0
    """Sum of view weights that a voxel needs to count as seen: that of one view which meets one
    surface there, or of several near the end of a surface; just behind it a view counts less."""
    triangle_budget: Annotated[int, Range(100, 1_000_000_000), Basic()] = 1_500_000
    """Triangles of the mesh; a chosen voxel size aims at them, to about 20 %, before those that the
    surface does not need are merged."""
    detail: Annotated[float, Range(0, 16)] = 1.0
    """Tolerance of merging triangles: 99 % of the surface moves by less, and on average by less
    than 0.15 of it; voxels, 0 merges none."""
    smoothing: Annotated[float, Range(0, 16)] = 0.5
    """Most that vertices of merged triangles may move to make nearly parallel facets parallel;
    voxels, 0 leaves them as they are."""
    memory_limit: Annotated[float, Range(1e-3, 1e6)] = 2.0
    """Most memory for the volume in GiB."""
    min_component_faces: CountOrZero = 100
    """Connected parts with fewer faces are removed."""
    max_components: Annotated[int | None, Range(1)] = None
    """Keep only so many of the largest parts; none keeps all (1 suits a single object)."""
    colour: bool = True
    """Colour the vertices from the keyframe images."""
