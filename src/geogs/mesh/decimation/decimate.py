"""A mesh with as few triangles as its surface needs."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.mesh.clean import remove_degenerate_faces
from geogs.mesh.decimation.collapse import CollapsingMesh
from geogs.mesh.decimation.deviation import device_deviations, host_deviations
from geogs.mesh.denoise import denoised
from geogs.mesh.triangle_mesh import Mesh
from geogs.threads import worker_count

QUANTILE = 0.99
"""Part of the vertices that may not lie farther from the decimated surface than is allowed."""
MEAN_FRACTION = 0.15
"""Fraction of what is allowed that they may be off on average: else what is smooth becomes facets,
all of it as far away as may be."""
_SAMPLES = 10_000
_BOUNDS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.75, 1.0)
"""Fractions of what is allowed to which costs of edges are held, one after the other."""
_WORTH_A_LOOK = 0.98
"""Part of the triangles to which a wider bound has to bring a mesh, if that is to be checked."""
_FEWEST = 200
"""Triangles below which nothing is gained."""


def decimate(mesh: Mesh, tolerance: float, smoothing: float = 0.0) -> Mesh:
    """Collapse edges by quadric error for as long as the surface stays where it was.

    What is left is smoothed, by which its vertices move by ``smoothing`` (map units) at most.

    Colours are the means of those of the vertices that each new one stands for. Of a mesh that
    this would not make smaller nothing changes. See :func:`merged`.
    """
    few = merged(torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces), tolerance)
    if few is None:
        return mesh
    colours = None
    if mesh.colours is not None:
        given = torch.from_numpy(mesh.colours).float()
        mean, _ = few.means(given, torch.ones(len(given), dtype=torch.bool))
        colours = (mean + 0.5).to(torch.uint8).numpy()
    vertices = denoised(few.position, few.faces, smoothing)
    new = Mesh.from_triangles(vertices.numpy(), few.faces.numpy())
    return remove_degenerate_faces(replace(new, colours=colours))


def merged(
    vertices: Float[Tensor, "n 3"], faces: Int[Tensor, "m 3"], tolerance: float
) -> CollapsingMesh | None:
    """The mesh with as few triangles as its surface needs; None where there is nothing to gain.

    99 % of the vertices lie within ``tolerance`` (map units) of the decimated surface, and on
    average within 15 % of that; borders stay as they are. Computed on the device of the vertices.

    Edges are collapsed up to some cost, and then up to higher ones, until the surface is off by
    more than it may be.
    """
    if tolerance <= 0 or len(faces) < _FEWEST:
        return None
    allowed = np.array([tolerance, MEAN_FRACTION * tolerance])
    found, mesh = None, CollapsingMesh(vertices, faces)
    for bound in _BOUNDS:
        mesh = mesh.reduced(bound * tolerance)
        if len(mesh.faces) > _WORTH_A_LOOK * len(faces if found is None else found.faces):
            continue
        if not len(mesh.faces) or (_deviation(mesh, vertices) > allowed).any():
            break
        found = mesh
    return found


def _deviation(mesh: CollapsingMesh, before: Float[Tensor, "n 3"]) -> Float[np.ndarray, "2"]:
    """Distance to a mesh of the vertices before: that of nearly all of them, and the mean."""
    step = 1 + len(before) // _SAMPLES
    samples, became = before[::step], mesh.became[::step].clamp(min=0)
    arrays = samples, mesh.position.float(), mesh.faces, became
    if samples.device.type == "cpu":
        away = host_deviations(*(array.numpy() for array in arrays))
    else:
        away = device_deviations(*arrays).cpu().numpy()
    return np.array([np.quantile(away, QUANTILE), away.mean()])


def with_at_most(mesh: Mesh, faces: int) -> Mesh:
    """The mesh with about so many triangles, whatever that does to its surface; if it has no more
    than that, the same."""
    if len(mesh.faces) <= faces:
        return mesh
    fewer = _simplified(mesh.vertices, mesh.faces, faces / len(mesh.faces))
    if len(fewer[1]) > faces:  # of a mesh in scraps most is border
        fewer = _simplified(*fewer, faces / len(fewer[1]), keep_borders=False)
    return remove_degenerate_faces(_with_colours_of(mesh, *fewer))


def _simplified(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    fraction: float,
    keep_borders: bool = True,
) -> tuple[Float[np.ndarray, "k 3"], Int[np.ndarray, "l 3"]]:
    """About that fraction of the faces."""
    import fast_simplification

    count = max(int(fraction * len(faces)), 4)
    vertices, faces = fast_simplification.simplify(
        vertices, faces, target_count=count, preserve_border=keep_borders
    )
    return vertices.astype(np.float32), faces.astype(np.int32)


def _with_colours_of(
    mesh: Mesh, vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]
) -> Mesh:
    """The vertices and faces with the colours of the mesh that they were made from.

    Normals are their own: those of the mesh before, averaged, are noisier (of two rendered rooms
    0.3 degrees farther from the truth in the median).
    """
    from scipy.spatial import cKDTree

    made = Mesh.from_triangles(vertices, faces)
    if mesh.colours is None:
        return made
    _, nearest = cKDTree(vertices).query(mesh.vertices, workers=worker_count())
    count = np.bincount(nearest, minlength=len(vertices))
    total = [np.bincount(nearest, channel, len(vertices)) for channel in mesh.colours.T]
    colours = np.stack(total, -1) / np.maximum(count, 1)[:, None]
    _, closest = cKDTree(mesh.vertices).query(vertices[count == 0])
    colours[count == 0] = mesh.colours[closest]
    return replace(made, colours=(colours + 0.5).astype(np.uint8))
