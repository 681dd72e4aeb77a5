"""The loops over faces against the same written with whole arrays."""

import numpy as np
import pytest

from geogs.mesh.face_kernels import border_edges, face_sizes, normal_sums


def soup(faces: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random triangles over few vertices, so that many edges are shared; some repeat a vertex."""
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(40, 3)).astype(np.float32)
    return vertices, rng.integers(0, 40, (faces, 3)).astype(np.int32)


def crossed(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = vertices.astype(np.float64)[faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a)


@pytest.mark.parametrize("faces", [0, 1, 300])
def test_normals_add_up_at_the_vertices(faces):
    vertices, triangles = soup(faces)
    expected = np.zeros((len(vertices), 3))
    for face, normal in zip(triangles, crossed(vertices, triangles), strict=True):
        for vertex in face:
            expected[vertex] += normal
    np.testing.assert_allclose(normal_sums(vertices, triangles), expected, atol=1e-12)


@pytest.mark.parametrize("faces", [0, 1, 300])
def test_sizes_of_faces(faces):
    vertices, triangles = soup(faces, 1)
    areas = np.full(faces, np.nan)
    mean = face_sizes(vertices, triangles, areas)
    corners = vertices.astype(np.float64)[triangles]
    edges = corners - np.roll(corners, 1, axis=1)
    assert mean == pytest.approx((edges**2).sum(-1).mean() if faces else 0.0)
    expected = (crossed(vertices, triangles) ** 2).sum(-1)
    np.testing.assert_allclose(areas, expected, rtol=1e-9, atol=1e-12)
    assert (areas[[len({*face}) < 3 for face in triangles.tolist()]] < 1e-12).all()


@pytest.mark.parametrize("faces", [0, 1, 30, 300, 2000])
def test_borders_are_edges_that_no_face_has_the_other_way(faces):
    _, triangles = soup(faces, 2)
    edges = [(f[k], f[(k + 1) % 3]) for f in triangles.tolist() for k in range(3)]
    there = {*edges}
    expected = [(a, b) for a, b in edges if (b, a) not in there]
    found = border_edges(triangles, 40)
    assert [tuple(edge) for edge in found.tolist()] == expected
    assert found.shape == (len(expected), 2)
    assert faces not in (30, 300) or 0 < len(expected) < len(edges)
