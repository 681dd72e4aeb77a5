"""Surface extraction: depth maps to a coloured triangle mesh."""

from geogs.mesh.extract import VolumePlan, extract_mesh, plan_volume
from geogs.mesh.types import DepthMapView, Mesh

__all__ = ["DepthMapView", "Mesh", "VolumePlan", "extract_mesh", "plan_volume"]
