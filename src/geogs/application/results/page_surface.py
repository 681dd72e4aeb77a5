"""The surface of the page: with few triangles, and a texture of the keyframes' images."""

from collections.abc import Sequence

import numpy as np

from geogs.application.results.surfaces import fusion_views
from geogs.errors import InputError
from geogs.evaluation.model_view.shown_model import TextureModel
from geogs.geometry.creases import creased
from geogs.io.writers.exports.mesh_writers import encoded_jpeg
from geogs.mesh.decimation.decimate import with_at_most
from geogs.mesh.texture.textured import TexturedMesh, texture_mesh
from geogs.mesh.triangle_mesh import Mesh, median_edge
from geogs.on_demand import OnDemand
from geogs.types import RenderedKeyframe

MAX_FACES, MAX_TEXTURED = 240_000, 160_000
"""Largest numbers of triangles without and with a texture, which divides vertices at its seams."""
MAX_VIEWS, MAX_EDGE = 120, 2048
"""Largest number of keyframes that a texture is made of, and its longest side in pixels."""


def page_surface(
    mesh: Mesh, renders: Sequence[RenderedKeyframe]
) -> tuple[Mesh, TextureModel | None]:
    """The mesh with at most as many triangles as a page holds, and its texture.

    There is none where no keyframe has an image, or none shows any of the mesh.
    """
    count = min(len(renders), MAX_VIEWS)
    chosen = np.linspace(0, len(renders) - 1, count).round().astype(int).tolist()
    if count and renders[0].image is not None:
        views = fusion_views(OnDemand(chosen, renders.__getitem__))
        few = with_at_most(mesh, MAX_TEXTURED)
        try:
            textured = texture_mesh(few, views, 2 * median_edge(mesh), MAX_EDGE)
        except InputError:  # the images show nothing of it
            pass
        else:
            return _with_creases(few, textured)
    return with_at_most(mesh, MAX_FACES).creased(), None


def _with_creases(mesh: Mesh, textured: TexturedMesh) -> tuple[Mesh, TextureModel]:
    """The mesh with vertices of their own at seams of the texture and at sharp edges."""
    origin, faces, normals = creased(mesh.vertices, mesh.faces)
    corner = textured.faces.ravel().astype(np.int64) * len(origin) + faces.ravel()
    own, number = np.unique(corner, return_inverse=True)
    of_texture, of_crease = np.divmod(own, len(origin))
    colours = None if mesh.colours is None else mesh.colours[origin[of_crease]]
    shown = Mesh(
        textured.vertices[of_texture],
        number.reshape(-1, 3).astype(np.int32),
        normals[of_crease],
        colours,
    )
    size = np.array(textured.texture.shape[1::-1])
    uv = (textured.uv[of_texture] + 0.5) / size
    return shown, TextureModel(uv, encoded_jpeg(textured.texture))
