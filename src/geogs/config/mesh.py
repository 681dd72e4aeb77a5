"""Settings of the surface."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MeshConfig:
    """Surface extraction."""

    voxel: float | None = None
    """Voxel size in map units; chosen from depth, budget and memory limit if none is given."""
    voxel_per_pixel: float = 1.0
    """Chosen voxel size in footprints of a depth map's pixel at the median depth, above 0."""
    truncation: float = 4.0
    """Voxels in front of and behind a surface in which distances are averaged, at least 2."""
    max_depth: float | None = None
    """Farther pixels are left out, map units; twice the 95 % quantile if none is given."""
    min_weight: float = 1.5
    """Sum of view weights that a voxel needs to count as seen, above 0; just behind a surface a
    view counts less than in front, so 1.5 asks for two sure views."""
    triangle_budget: int = 1_500_000
    """Triangles that a chosen voxel size aims at, to about 20 %."""
    memory_limit: float = 2.0
    """Most memory for the volume in GiB."""
    min_component_faces: int = 100
    """Connected parts with fewer faces are removed."""
    min_component_fraction: float = 0.001
    """Parts with fewer faces than this fraction of the largest part's are removed, 0 to 1."""
    max_components: int | None = None
    """Keep only so many of the largest parts; none keeps all (1 suits a single object)."""
    colour: bool = True
    """Colour the vertices from the keyframe images."""
