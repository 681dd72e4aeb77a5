"""Small holes are closed; large ones, and those that somebody looked through, are not."""

import numpy as np
import pytest
import torch

from geogs.config import MeshConfig
from geogs.geometry.camera import Camera
from geogs.mesh import clean
from geogs.mesh.clean import IsFree, border_edges, border_loops, keep_faces, with_closed_holes
from geogs.mesh.extract import extract_mesh
from geogs.mesh.tensor_mesh import TensorMesh
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.mesh.volume.free_space import FreeSpace
from geogs.mesh.volume.tsdf import BLOCK, SparseTsdf

N = 21


def never(points: np.ndarray) -> np.ndarray:
    return np.zeros(len(points), bool)


def sheet(*holes: tuple[int, int, int]) -> Mesh:
    """A slightly curved grid without the cells of squares: row, column, side."""
    y, x = np.meshgrid(np.arange(N), np.arange(N), indexing="ij")
    z = 0.01 * (x - 10.0) ** 2
    cell = (np.arange(N - 1)[:, None] * N + np.arange(N - 1)).ravel()
    faces = np.stack([cell, cell + 1, cell + N, cell + 1, cell + N + 1, cell + N], -1)
    keep = np.ones((N - 1, N - 1), bool)
    for row, column, side in holes:
        keep[row : row + side, column : column + side] = False
    mesh = Mesh.from_triangles(np.stack([x, y, z], -1).reshape(-1, 3), faces.reshape(-1, 3))
    return keep_faces(mesh, np.repeat(keep.ravel(), 2))


def close_holes(mesh: Mesh, most_edges: int, is_free: IsFree) -> Mesh:
    there = TensorMesh.of(mesh.vertices, mesh.faces)
    made, normals = with_closed_holes(there, most_edges, is_free)
    return Mesh(made.vertices.numpy(), made.faces.int().numpy(), normals.numpy())


def open_edges(mesh: Mesh) -> int:
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    count = np.unique(edges, axis=0, return_counts=True)[1]
    assert count.max() <= 2
    return int((count == 1).sum())


def test_loops_go_round_every_border_once():
    mesh = sheet((3, 3, 1), (8, 8, 3), (15, 8, 1))
    border = border_edges(TensorMesh.of(mesh.vertices, mesh.faces)).numpy()
    loops = list(border_loops(border, 100))
    assert [loop.shape for loop in loops] == [(2, 4), (1, 12), (1, 80)]
    assert len({vertex for loop in loops for vertex in loop.ravel().tolist()}) == 100
    backwards = {(end, start) for start, end in border.tolist()}
    for loop in loops:
        steps = np.stack([loop, np.roll(loop, -1, axis=1)], -1).reshape(-1, 2)
        assert {tuple(step) for step in steps.tolist()} <= backwards
    assert [loop.shape for loop in border_loops(border, 8)] == [(2, 4)]


def test_small_holes_are_closed_and_turn_the_same_side_up():
    mesh = sheet((3, 3, 1), (8, 8, 3))
    small = close_holes(mesh, 8, never)
    assert open_edges(small) == 80 + 12
    both = close_holes(mesh, 16, never)
    assert open_edges(both) == 80
    assert len(both.vertices) == len(mesh.vertices) + 2
    up = Mesh.from_triangles(both.vertices, both.faces).normals
    assert (up[:, 2] > 0.9).all()
    np.testing.assert_allclose((both.normals[-2:] * up[-2:]).sum(-1), 1, atol=0.02)


def test_holes_that_touch_at_a_vertex_stay_open():
    mesh = sheet((3, 3, 1), (4, 4, 1))
    assert open_edges(close_holes(mesh, 16, never)) == 80 + 8


def test_what_is_free_and_what_folds_over_stays_open():
    mesh = sheet((3, 3, 1), (12, 12, 1))

    def high(points: np.ndarray) -> np.ndarray:
        return points[:, 1] > 10

    assert open_edges(close_holes(mesh, 16, high)) == 80 + 4
    lone = Mesh.from_triangles(np.eye(3), np.array([[0, 1, 2]]))
    assert len(close_holes(lone, 16, never).faces) == 1  # its outer border runs the other way


def test_what_is_free_is_asked_of_the_voxel_nearest_to_a_point():
    tsdf = SparseTsdf(0.1, 4.0)
    camera = Camera(40.0, 40.0, 19.5, 14.5, 40, 30)
    depth = torch.full((30, 40), 2.0)
    tsdf.integrate(depth, torch.ones(30, 40), camera, torch.eye(4, dtype=torch.float64))
    random = np.random.default_rng(0)
    points = random.uniform([-1, -1, 1.2], [1, 1, 2.5], (200, 3))
    free, expected = FreeSpace.of(tsdf, 0.9), []
    for point in points:
        voxel = np.rint(point / 0.1).astype(int)
        block = voxel // BLOCK
        slot = (tsdf.coordinates.numpy() == block).all(-1).nonzero()[0]
        place = tuple((voxel - BLOCK * block).tolist())
        expected.append(
            bool(len(slot))
            and float(tsdf.weight[slot[0]][place]) >= 0.9
            and float(tsdf.distance[slot[0]][place]) > 0.5
        )
    assert free(points).tolist() == expected
    assert 0.03 < np.mean(expected) < 0.97
    far = np.array([[1e9, 0.0, 0.0]])
    assert not free(far)[0]


@pytest.mark.parametrize("looked_through", [False, True])
def test_a_gap_in_the_depths_is_closed_unless_there_is_more_behind(looked_through, monkeypatch):
    camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    depth = torch.full((48, 64), 2.0)
    depth[20:23, 30:33] = 2.6 if looked_through else 0.0
    pose = torch.eye(4, dtype=torch.float64)
    views = [DepthMapView(depth, (depth > 0).float(), camera, pose) for _ in range(3)]
    few = {"voxel": 0.035, "detail": 0, "min_component_faces": 10, "colour": False}
    made = []
    for edges in (0, 24):
        monkeypatch.setattr(clean, "CLOSED_HOLES", edges)
        made.append(extract_mesh(views, MeshConfig(**few)))
    as_it_was, closed = made
    assert (open_edges(closed) == open_edges(as_it_was)) == looked_through
