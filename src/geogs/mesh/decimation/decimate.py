"""Decimation of a mesh to as few triangles as its surface needs."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.geometry.neighbors import nearest_neighbors
from geogs.mesh.clean import remove_degenerate_faces
from geogs.mesh.decimation.collapse import CollapsingMesh
from geogs.mesh.denoise import denoised
from geogs.mesh.triangle_mesh import Mesh
from geogs.threads import worker_count

QUANTILE = 0.99
"""Fraction of the vertices that must lie within the tolerance of the decimated surface."""
MEAN_FRACTION = 0.15
"""Largest mean distance of the vertices, as a fraction of the tolerance: else a smooth surface
becomes facets that are as far away as allowed."""
_SAMPLES = 10_000
"""Most vertices whose distances are computed."""
_NEAREST_VERTICES = 3
"""Vertices around a point whose faces are tested."""
_BOUNDS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.75, 1.0)
"""Successive bounds of the edges' costs, as fractions of the tolerance."""
_WORTH_A_LOOK = 0.98
"""Fraction of the triangles that a wider bound may leave for the mesh to be checked."""
_FIRST_BOUND, _LAST_BOUND, _WIDER = 1e-5, 0.02, 1.5
"""Bounds for a mesh with a largest number of triangles: the first and the last, as fractions of its
extent, and the factor from one to the next."""
_FEWEST = 200
"""Number of triangles below which nothing is gained."""


def decimate(mesh: Mesh, tolerance: float, smoothing: float = 0.0) -> Mesh:
    """Collapse edges by quadric error for as long as the surface stays where it was.

    The result is smoothed; this moves its vertices by at most ``smoothing`` (map units).

    Colours are means over the vertices that each new one stands for. A mesh that this would not
    make smaller stays as it is. See :func:`merged`.
    """
    few = merged(torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces), tolerance)
    if few is None:
        return mesh
    return _coloured(mesh, few, denoised(few.position, few.faces, smoothing))


def merged(
    vertices: Float[Tensor, "n 3"], faces: Int[Tensor, "m 3"], tolerance: float
) -> CollapsingMesh | None:
    """The mesh with as few triangles as its surface needs; None where there is nothing to gain.

    99 % of the vertices lie within ``tolerance`` (map units) of the decimated surface, and on
    average within 15 % of that; borders stay as they are. Computed on the device of the vertices.

    Edges are collapsed up to some cost, and then up to higher ones, until the surface is off by
    more than allowed.
    """
    if tolerance <= 0 or len(faces) < _FEWEST:
        return None
    allowed = np.array([tolerance, MEAN_FRACTION * tolerance])
    found = None
    mesh = CollapsingMesh(vertices, faces)
    for bound in _BOUNDS:
        mesh = mesh.reduced(bound * tolerance)
        if len(mesh.faces) > _WORTH_A_LOOK * len(faces if found is None else found.faces):
            continue
        if not len(mesh.faces) or (_deviation(mesh, vertices) > allowed).any():
            break
        found = mesh
    return found


def _deviation(mesh: CollapsingMesh, before: Float[Tensor, "n 3"]) -> Float[np.ndarray, "2"]:
    """Distance of the original vertices to a mesh: the ``QUANTILE`` and the mean."""
    step = 1 + len(before) // _SAMPLES
    samples = before[::step]
    became = mesh.became[::step].clamp(min=0)
    arrays = samples, mesh.position.float(), mesh.faces, became
    if samples.device.type == "cpu":
        away = host_deviations(*(array.numpy() for array in arrays))
    else:
        away = device_deviations(*arrays).cpu().numpy()
    return np.array([np.quantile(away, QUANTILE), away.mean()])


def host_deviations(
    points: Float[np.ndarray, "k 3"],
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    known: Int[np.ndarray, "k"],
) -> Float[np.ndarray, "k"]:
    """Distance of each point to the nearest face of those around the vertices nearest to it, and
    around one that is known to be near; every vertex has a face.

    It is the distance to the mesh, or a little more where faces differ much in size.
    """
    from scipy.spatial import cKDTree

    from geogs.mesh.decimation.decimation_kernels import nearest_faces, rings

    # For a single query most of the time would go into balancing the tree.
    tree = cKDTree(vertices, balanced_tree=False, compact_nodes=False)
    _, near = tree.query(points, k=_NEAREST_VERTICES, workers=worker_count())
    near = np.column_stack([near, known])
    first, corners = rings(faces.ravel(), len(vertices))
    triangles = vertices.astype(np.float64)[faces]
    return nearest_faces(points.astype(np.float64), near, first, corners // 3, triangles)


def device_deviations(
    points: Float[Tensor, "k 3"],
    vertices: Float[Tensor, "n 3"],
    faces: Int[Tensor, "m 3"],
    known: Int[Tensor, "k"],
) -> Float[Tensor, "k"]:
    """:func:`host_deviations` on any device."""
    _, near = nearest_neighbors(points, vertices, _NEAREST_VERTICES)
    near = torch.cat([near, known[:, None]], 1)
    vertex, corners = faces.flatten().sort(stable=True)
    first = torch.searchsorted(vertex, near.flatten().to(vertex.dtype))
    count = torch.searchsorted(vertex, near.flatten().to(vertex.dtype), right=True) - first
    pair = torch.arange(len(count), device=faces.device).repeat_interleave(count)
    number = torch.arange(len(pair), device=faces.device) - (count.cumsum(0) - count)[pair]
    face = corners[first[pair] + number] // 3
    point = pair // near.shape[1]
    triangles = vertices.double()[faces[face].long()]
    away = triangle_distances(points.double()[point], triangles)
    return away.new_full((len(points),), torch.inf).scatter_reduce(0, point, away, "amin")


def triangle_distances(
    points: Float[Tensor, "k 3"], triangles: Float[Tensor, "k 3 3"]
) -> Float[Tensor, "k"]:
    """Distance of each point to a triangle of its own (its corners in rows)."""
    edges = triangles.roll(-1, 1) - triangles
    normal = torch.linalg.cross(edges[:, 0], -edges[:, 2])
    length = normal.norm(dim=-1)
    offset = points[:, None] - triangles
    turn = (torch.linalg.cross(edges, offset) * normal[:, None]).sum(-1)
    inside = (turn >= 0).all(-1) & (length > 0)
    squared = edges.square().sum(-1)
    fraction = (offset * edges).sum(-1) / torch.where(squared > 0, squared, 1.0)
    foot = fraction.clamp(0, 1)[..., None] * edges
    to_edges = (offset - foot).norm(dim=-1).amin(-1)
    to_plane = (offset[:, 0] * normal).sum(-1).abs() / torch.where(length > 0, length, 1.0)
    return torch.where(inside, to_plane, to_edges)


def with_at_most(mesh: Mesh, faces: int) -> Mesh:
    """Reduce a mesh to at most ``faces`` triangles; one with no more stays as it is.

    Edges are collapsed up to a cost that grows until they are few enough. Borders are not: if the
    mesh has too many, vertices are clustered in cubes that grow likewise.
    """
    if len(mesh.faces) <= faces:
        return mesh
    size = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    bound = _FIRST_BOUND * size
    few = CollapsingMesh(torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces))
    while len(few.faces) > faces and bound < _LAST_BOUND * size:
        few = few.reduced(bound)
        bound *= _WIDER
    made = _coloured(mesh, few, few.position)
    cube = _FIRST_BOUND * size
    clustered = made
    while len(clustered.faces) > faces:
        clustered = _clustered(made, cube)
        cube *= _WIDER
    return clustered


def _clustered(mesh: Mesh, side: float) -> Mesh:
    """The mesh with the vertices in each cube of this side merged into their mean."""
    _, cluster = np.unique(np.floor(mesh.vertices / side), axis=0, return_inverse=True)
    cluster = cluster.ravel()
    number = np.bincount(cluster)[:, None]
    means = [
        np.stack([np.bincount(cluster, column) for column in values.T], 1) / number
        for values in (mesh.vertices, mesh.colours)
        if values is not None
    ]
    made = Mesh.from_triangles(means[0], cluster[mesh.faces])
    colours = None if mesh.colours is None else (means[1] + 0.5).astype(np.uint8)
    return remove_degenerate_faces(replace(made, colours=colours))


def _coloured(mesh: Mesh, few: CollapsingMesh, vertices: Float[Tensor, "k 3"]) -> Mesh:
    """Make a mesh of decimated vertices; colours are means over those that each stands for."""
    colours = None
    if mesh.colours is not None:
        given = torch.from_numpy(mesh.colours).float()
        mean, _ = few.means(given, torch.ones(len(given), dtype=torch.bool))
        colours = (mean + 0.5).to(torch.uint8).numpy()
    new = Mesh.from_triangles(vertices.numpy(), few.faces.numpy())
    return remove_degenerate_faces(replace(new, colours=colours))
