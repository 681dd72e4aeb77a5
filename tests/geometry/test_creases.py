"""Normals of a mesh: smooth where it is, and apart where it has an edge."""

import numpy as np

from box_room import box
from geogs.geometry.creases import creased


def ball(rings: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A sphere of triangles, facing outwards."""
    v, u = np.mgrid[0 : rings + 1, 0 : 2 * rings]
    polar, round = np.pi * v / rings, np.pi * u / rings
    x = np.sin(polar) * np.cos(round), np.sin(polar) * np.sin(round), np.cos(polar)
    a, right = v[:-1] * 2 * rings + u[:-1], v[:-1] * 2 * rings + (u[:-1] + 1) % (2 * rings)
    below, across = a + 2 * rings, right + 2 * rings
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in (
        (a, below, right), (right, below, across),
    )])  # fmt: skip
    return np.stack(x, -1).reshape(-1, 3).astype(np.float32), faces.astype(np.int32)


def test_a_ball_is_smooth_and_keeps_its_vertices():
    vertices, faces = ball()
    origin, split, normals = creased(vertices, faces)
    np.testing.assert_array_equal(origin, np.arange(len(vertices)))
    np.testing.assert_array_equal(split, faces)
    inner = np.abs(vertices[:, 2]) < 0.95
    cosine = (normals * vertices).sum(1)[inner]
    assert np.degrees(np.arccos(cosine.clip(-1, 1))).max() < 2


def test_a_box_has_three_normals_at_each_corner_and_flat_walls():
    vertices, faces = box((3.0, 2.0, 1.2))
    origin, split, normals = creased(vertices.astype(np.float32), faces)
    assert (np.bincount(origin) == 3).all()
    np.testing.assert_array_equal(origin[split], faces)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    facing = np.cross(b - a, c - a)
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    for corner in range(3):
        np.testing.assert_allclose(normals[split[:, corner]], facing, atol=1e-6)


def test_nothing_and_faces_without_an_area_have_no_normals():
    origin, split, normals = creased(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    assert len(origin) == len(split) == len(normals) == 0
    origin, _, normals = creased(np.ones((3, 3)), np.array([[0, 1, 2]], np.int32))
    assert len(origin) == 3
    assert (normals == 0).all()
