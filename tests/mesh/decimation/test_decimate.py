"""Fewer triangles, the same surface."""

import numpy as np
import pytest
import torch

from geogs.errors import InputError
from geogs.io.writers.ply_writer import write_mesh
from geogs.mesh.decimation.decimate import (
    MEAN_FRACTION,
    QUANTILE,
    decimate,
    host_deviations,
    triangle_distances,
    with_at_most,
)
from geogs.mesh.decimation.decimation_kernels import triangle_distance
from geogs.mesh.mesh_file import read_mesh
from geogs.mesh.triangle_mesh import Mesh
from surface_shapes import hills


def border(mesh: Mesh) -> set[tuple[float, ...]]:
    """Vertices at edges that one face has."""
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    return set(map(tuple, mesh.vertices[np.unique(edges[count == 1])].tolist()))


def slow_distance(point: np.ndarray, corners: np.ndarray) -> float:
    """The least of the distances to many points of a triangle."""
    s, t = np.meshgrid(np.linspace(0, 1, 300), np.linspace(0, 1, 300))
    inside = s + t <= 1
    a, b, c = corners
    points = a + s[inside][:, None] * (b - a) + t[inside][:, None] * (c - a)
    return float(np.linalg.norm(points - point, axis=1).min())


def distances(points: np.ndarray, mesh: Mesh) -> np.ndarray:
    """Distance of each point to the nearest of all faces."""
    triangles = torch.from_numpy(mesh.vertices.astype(np.float64)[mesh.faces])
    rows = torch.from_numpy(points.astype(np.float64))[:, None].expand(-1, len(triangles), 3)
    return np.array([float(triangle_distances(row, triangles).min()) for row in rows])


def test_distance_to_a_triangle_is_that_to_the_nearest_of_its_points():
    random = np.random.default_rng(0)
    points, triangles = random.normal(size=(60, 3)), random.normal(size=(60, 3, 3))
    pairs = list(zip(points, triangles, strict=True))
    fast = np.array([triangle_distance(*pair) for pair in pairs])
    slow = np.array([slow_distance(*pair) for pair in pairs])
    assert (fast <= slow + 1e-9).all()
    np.testing.assert_allclose(fast, slow, atol=0.02)


def test_distance_to_a_triangle_without_area_is_that_to_its_edge():
    a, b = np.zeros(3), np.array([2.0, 0, 0])
    for c in (a, b, (a + b) / 2):
        assert triangle_distance(np.array([1.0, 3, 4]), np.stack([a, b, c])) == pytest.approx(5.0)


def test_deviation_is_the_distance_to_the_mesh():
    mesh = hills()
    moved = mesh.vertices + 0.02 * mesh.normals
    found = host_deviations(moved[:500], mesh.vertices, mesh.faces, np.arange(500))
    assert found.max() <= 0.02 + 1e-6
    assert np.median(found) == pytest.approx(0.02, rel=0.05)


def test_a_vertex_known_to_be_near_finds_the_face_among_large_ones():
    """Three vertices of a small face above a large one are nearer than its own."""
    corners = [[0, 0, 0], [9, 0, 0], [9, 9, 0], [8, 8, 2.5], [8.1, 8, 2.5], [8, 8.1, 2.5]]
    mesh = Mesh.from_triangles(np.array(corners), np.arange(6).reshape(2, 3))
    point = np.array([[7.0, 6.5, 0.5]], np.float32)
    assert host_deviations(point, mesh.vertices, mesh.faces, np.array([3]))[0] > 2
    near = host_deviations(point, mesh.vertices, mesh.faces, np.array([2]))
    np.testing.assert_allclose(near, 0.5, atol=1e-6)
    np.testing.assert_allclose(distances(point, mesh), 0.5, atol=1e-6)


@pytest.mark.parametrize("tolerance", [0.002, 0.01])
def test_the_surface_stays_within_the_tolerance_and_keeps_its_border(tolerance):
    mesh = hills()
    few = decimate(mesh, tolerance)
    assert len(few.faces) < 0.5 * len(mesh.faces)
    away = distances(mesh.vertices[::3], few)
    assert np.quantile(away, QUANTILE) <= tolerance * 1.1
    assert away.mean() <= 1.1 * MEAN_FRACTION * tolerance
    assert border(few) == border(mesh)
    assert few.faces.min() == 0
    assert few.faces.max() == len(few.vertices) - 1
    facing = Mesh.from_triangles(few.vertices, few.faces).normals[:, 2]
    assert (facing > 0.3).all()


def test_colours_and_normals_are_those_of_the_surface_there():
    mesh = hills()
    few = decimate(mesh, 0.01)
    x, y = few.vertices[:, 0], few.vertices[:, 1]
    expected = np.stack([127 * (x + 1), 127 * (y + 1)], -1)
    assert np.abs(few.colours[:, :2] - expected).mean() < 6
    radius = 0.3 * np.exp(-8 * (x**2 + y**2)) * 16
    normal = np.stack([radius * x, radius * y, np.ones(len(x))], -1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert np.median((normal * few.normals).sum(-1)) > 0.99
    np.testing.assert_allclose(np.linalg.norm(few.normals, axis=1), 1, atol=1e-5)


def test_nothing_happens_where_nothing_may_move_and_twice_is_the_same():
    mesh = hills()
    assert decimate(mesh, 0.0) is mesh
    once, twice = decimate(mesh, 0.005), decimate(mesh, 0.005)
    np.testing.assert_array_equal(once.vertices, twice.vertices)
    np.testing.assert_array_equal(once.faces, twice.faces)


def test_a_mesh_is_read_as_it_was_written(tmp_path):
    mesh = hills(8)
    path = tmp_path / "mesh.ply"
    write_mesh(path, mesh.vertices, mesh.faces, mesh.colours, mesh.normals)
    read = read_mesh(path)
    for name in ("vertices", "faces", "normals", "colours"):
        np.testing.assert_array_equal(getattr(read, name), getattr(mesh, name))
    write_mesh(path, mesh.vertices, mesh.faces)
    read = read_mesh(path)
    assert read.colours is None
    np.testing.assert_allclose(read.normals, mesh.normals, atol=1e-6)
    write_mesh(path, mesh.vertices[:5], mesh.faces)
    with pytest.raises(InputError, match="no triangles of its vertices"):
        read_mesh(path)


def test_no_more_is_shown_than_asked_for_even_of_scraps():
    """Ribbons of two triangles' width, which are nearly all border."""
    along, across = np.meshgrid(np.linspace(0, 10, 201), np.linspace(0, 0.1, 3))
    flat = np.stack([along, across, 0.05 * np.sin(3 * along)], -1).reshape(-1, 3)
    row, column = (index.ravel() for index in np.meshgrid(np.arange(2), np.arange(200)))
    a = 201 * row + column
    ribbon = np.concatenate(
        [np.stack([a, a + 1, a + 201], 1), np.stack([a + 1, a + 202, a + 201], 1)]
    )
    count = 12
    vertices = np.concatenate([flat + np.array([0, 0.3 * k, 0]) for k in range(count)])
    faces = np.concatenate([ribbon + len(flat) * k for k in range(count)])
    mesh = Mesh.from_triangles(vertices, faces)
    fewer = with_at_most(mesh, len(faces) // 4)
    assert 0.4 * len(faces) / 4 < len(fewer.faces) <= len(faces) / 4
    assert np.allclose(np.ptp(fewer.vertices, axis=0), np.ptp(vertices, axis=0), rtol=0.05)
    assert with_at_most(mesh, len(faces)) is mesh


def test_a_mesh_that_is_to_have_few_triangles_keeps_its_shape_and_colours():
    mesh = hills()
    fewer = with_at_most(mesh, len(mesh.faces) // 10)
    assert 0.02 * len(mesh.faces) < len(fewer.faces) <= len(mesh.faces) // 10
    x, y, z = fewer.vertices.T
    away = np.abs(z - 0.3 * np.exp(-8 * (x**2 + y**2)))
    print(len(fewer.faces), away.mean(), away.max())
    assert away.mean() < 0.003
    assert fewer.colours is not None
    assert len(fewer.colours) == len(fewer.vertices)
