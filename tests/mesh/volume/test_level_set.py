"""Marching cubes: closed whatever the signs, turned outwards, where the zero level is."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from skimage.measure import marching_cubes

from geogs.mesh.volume.level_set import MOST_TRIANGLES, cell_faces, loops_of, march, triangles_of


def all_seen(shape: tuple[int, ...]) -> np.ndarray:
    seen = np.ones(shape, bool)
    for axis in range(3):
        seen[(slice(None),) * axis + (0,)] = False
    return seen


def ball(size: int = 24, radius: float = 8.3) -> np.ndarray:
    x = np.arange(size) - 11.27
    return (np.sqrt(x[:, None, None] ** 2 + x[:, None] ** 2 + x**2) - radius).astype(np.float32)


def directed(triangles: np.ndarray) -> Counter:
    return Counter((int(t[k]), int(t[(k + 1) % 3])) for t in triangles for k in range(3))


def test_every_case_passes_each_crossed_edge_once():
    for case in range(256):
        edges = [e for loop in loops_of(case) for e in loop]
        crossed = sum((case >> a ^ case >> b) & 1 for a in range(8) for b in range(a) if
                      (a ^ b) in (1, 2, 4))  # fmt: skip
        assert len(edges) == len(set(edges)) == crossed
        assert len(triangles_of(case)) <= MOST_TRIANGLES
        assert all(len(loop) >= 3 for loop in loops_of(case))


def test_faces_are_walked_counter_clockwise_from_outside():
    place = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)], float)
    for face in cell_faces():
        a, b, c = place[face[:3]]
        outwards = place[face].mean(0) - 0.5
        assert np.cross(b - a, c - b) @ outwards > 0
        assert all((p ^ q) in (1, 2, 4) for p, q in pairwise([*face, face[0]]))


@pytest.mark.parametrize("seed", range(3))
def test_surfaces_of_noise_have_no_holes(seed):
    noise = np.random.default_rng(seed).standard_normal((12, 11, 13)).astype(np.float32)
    noise[[0, -1]] = noise[:, [0, -1]] = noise[:, :, [0, -1]] = 1.0
    vertices, _, triangles = march(noise, all_seen(noise.shape))
    assert len(triangles) > 1000
    edges = directed(triangles)
    assert all(edges[b, a] == count for (a, b), count in edges.items())
    assert sorted(set(triangles.reshape(-1).tolist())) == list(range(len(vertices)))


def test_a_ball_is_where_it_is_and_turned_outwards():
    distance = ball()
    vertices, axis, triangles = march(distance, all_seen(distance.shape))
    centred = vertices - 11.27
    assert np.abs(np.linalg.norm(centred, axis=1) - 8.3).max() < 0.02
    a, b, c = (centred[triangles[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 8.3**3, rel=0.01)
    fraction = vertices - np.floor(vertices)
    assert (fraction.argmax(1) == axis).all()
    assert (np.sort(fraction, 1)[:, :2] == 0).all()


def test_vertices_are_those_of_scikit_image():
    distance = ball()
    seen = all_seen(distance.shape)
    seen[:, :, 14:] = False
    vertices, _, triangles = march(distance, seen)
    theirs, their_faces, _, _ = marching_cubes(distance, 0.0, mask=seen, allow_degenerate=True)
    order = [np.lexsort(v.T) for v in (vertices, theirs)]
    np.testing.assert_allclose(vertices[order[0]], theirs[order[1]], atol=1e-5)
    assert len(triangles) == len(their_faces)


def test_where_nothing_was_seen_there_is_no_triangle():
    distance = ball()
    vertices, axis, triangles = march(distance, np.zeros(distance.shape, bool))
    assert (len(vertices), len(axis), len(triangles)) == (0, 0, 0)
