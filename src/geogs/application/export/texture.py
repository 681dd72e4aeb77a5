"""A textured mesh from a result in a folder."""

from geogs.application.results.saved_result import SavedResult
from geogs.application.results.surfaces import fusion_views
from geogs.errors import InputError
from geogs.mesh.texture.textured import TexturedMesh, texture_mesh
from geogs.mesh.types import Mesh, median_edge

TOLERANCE = 2.0
"""Median edges of the mesh that a face may lie off a depth map that shows it."""


def textured(result: SavedResult, mesh: Mesh, limit: int = 4096) -> TexturedMesh:
    """The mesh of a result with the images of its keyframes put together on it.

    ``limit`` is the longest side of the texture, pixels.

    Raises:
        InputError: the result has no keyframe images, or they show nothing of the mesh.
    """
    require_images(result)
    return texture_mesh(mesh, fusion_views(result.keyframes), TOLERANCE * median_edge(mesh), limit)


def require_images(result: SavedResult) -> None:
    """Raise InputError where a result has no images of its keyframes."""
    if not result.views.has_images:
        raise InputError("The result was written without keyframe images, which this needs.")
