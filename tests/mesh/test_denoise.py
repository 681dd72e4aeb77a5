"""Facets are made flat against their neighbours, and only there."""

import numpy as np
import pytest
import torch

from geogs.mesh.denoise import (
    _NORMAL_ROUNDS,
    _VERTEX_ROUNDS,
    NORMAL_DEVIATION,
    denoised,
    faces_beyond,
)


def _roof(noise: float, side: int = 21) -> tuple[torch.Tensor, torch.Tensor]:
    """Two planes that meet at 90 degrees along a row of vertices of a grid, moved at random."""
    u, v = np.meshgrid(np.arange(side), np.arange(side))
    across = (u - side // 2) * np.sqrt(0.5)
    vertices = np.stack([across, v, -np.abs(across)], -1).reshape(-1, 3).astype(float)
    vertices += np.random.default_rng(3).normal(0, noise, vertices.shape)
    a = (v[:-1, :-1] * side + u[:-1, :-1]).ravel()
    faces = np.concatenate([np.c_[a, a + 1, a + side], np.c_[a + 1, a + side + 1, a + side]])
    return torch.from_numpy(vertices), torch.from_numpy(faces)


def _ball(rounds: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    """An octahedron whose faces are quartered, on the unit sphere."""
    a = np.eye(3)
    faces = np.array(
        [[x, y, z] for x in (a[0], -a[0]) for y in (a[1], -a[1]) for z in (a[2], -a[2])]
    )
    faces[np.linalg.det(faces) < 0] = faces[np.linalg.det(faces) < 0][:, ::-1]
    for _ in range(rounds):
        x, y, z = faces.swapaxes(0, 1)
        u, v, w = x + y, y + z, z + x
        faces = np.concatenate(
            [np.stack(f, 1) for f in [(x, u, w), (u, y, v), (w, v, z), (u, v, w)]]
        )
        faces /= np.linalg.norm(faces, axis=2, keepdims=True)
    vertices, index = np.unique(faces.reshape(-1, 3).round(9), axis=0, return_inverse=True)
    return torch.from_numpy(vertices), torch.from_numpy(index.reshape(-1, 3))


def _angles(vertices: torch.Tensor, faces: torch.Tensor) -> np.ndarray:
    """Degrees between the facets and the planes of the roof."""
    a, b, c = vertices.numpy()[faces.numpy()].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    left = ((a + b + c)[:, 0] < 0)[:, None]
    true = np.where(left, [-1, 0, 1], [1, 0, 1]) / np.sqrt(2)
    return np.degrees(np.arccos(np.clip((normal * true).sum(1), -1, 1)))


def _slow(vertices: np.ndarray, faces: list[list[int]], reach: float) -> np.ndarray:
    """The oracle: facet by facet."""

    def cross(face: list[int]) -> np.ndarray:
        a, b, c = vertices[face]
        return np.cross(b - a, c - a)

    area = [float(np.linalg.norm(cross(face))) for face in faces]
    normal = [cross(face) / size for face, size in zip(faces, area, strict=True)]
    edges = [[frozenset((f[k], f[(k + 1) % 3])) for k in range(3)] for f in faces]
    sides = {e: [m for m, other in enumerate(edges) if e in other] for own in edges for e in own}
    for _ in range(_NORMAL_ROUNDS):
        turned = []
        for m, own in enumerate(edges):
            total = normal[m] * area[m]
            for edge in own:
                other = [n for n in sides[edge] if n != m]
                n = other[0] if len(other) == 1 else m
                apart = ((normal[m] - normal[n]) ** 2).sum()
                total = total + normal[n] * area[n] * np.exp(-apart / (2 * NORMAL_DEVIATION**2))
            turned.append(total / np.linalg.norm(total))
        normal = turned
    moved = vertices.copy()
    for _ in range(_VERTEX_ROUNDS):
        step = np.zeros_like(moved)
        for v in range(len(moved)):
            of = [m for m, face in enumerate(faces) if v in face]
            for m in of:
                height = normal[m] @ (moved[faces[m]].mean(0) - moved[v])
                step[v] += area[m] * height * normal[m] / sum(area[k] for k in of)
        moved += step
    away = moved - vertices
    moved = vertices.copy()
    for v in range(len(moved)):
        of = [m for m, face in enumerate(faces) if v in face]
        common = sum(area[m] * away[faces[m]].mean(0) for m in of) / sum(area[m] for m in of)
        own = away[v] - common
        moved[v] += own * min(1, reach / max(np.linalg.norm(own), 1e-300))

    def along(of: np.ndarray, m: int) -> float:
        a, b, c = of[faces[m]]
        return float(np.cross(b - a, c - a) @ normal[m] / np.linalg.norm(np.cross(b - a, c - a)))

    while True:
        folded = {
            v
            for m, face in enumerate(faces)
            if along(moved, m) < min(0, along(vertices, m))
            for v in face
            if (moved[face] != vertices[face]).any()
        }
        if not folded:
            return moved
        moved[list(folded)] = vertices[list(folded)]


def test_it_is_what_facet_by_facet_gives():
    vertices, faces = _roof(0.2, 5)
    faces = torch.cat([faces, torch.tensor([[6, 7, 24]])])  # a third face at one edge
    slow = _slow(vertices.numpy(), faces.tolist(), 0.05)
    np.testing.assert_allclose(denoised(vertices, faces, 0.05).numpy(), slow, atol=1e-9)
    assert np.abs(slow - vertices.numpy()).max() > 0.04


def test_planes_become_flat_and_the_edge_between_them_stays():
    vertices, faces = _roof(0.06)
    before, after = _angles(vertices, faces), _angles(denoised(vertices, faces, 0.5), faces)
    assert np.median(after) < 0.4 * np.median(before)
    ridge = np.abs(vertices[faces].mean(1)[:, 0].numpy()) < 0.4
    assert ridge.sum() > 30
    assert np.median(after[ridge]) < 0.45 * np.median(before[ridge])


def test_a_ball_does_not_shrink():
    vertices, faces = _ball()
    radius = denoised(vertices, faces, 0.1).norm(dim=1)
    sagitta = 1 - float(vertices[faces].mean(1).norm(dim=1).mean())
    assert abs(float(radius.mean()) - 1) < 0.06 * sagitta
    assert float((radius - 1).abs().max()) < sagitta


@pytest.mark.parametrize("reach", [0.0, 0.02])
def test_no_vertex_goes_farther_than_it_may(reach):
    vertices, faces = _roof(0.1)
    away = (denoised(vertices, faces, reach) - vertices).norm(dim=1)
    assert float(away.max()) <= reach * (1 + 1e-9)
    assert (float(away.max()) > 0) == (reach > 0)


def test_facets_without_an_area_and_single_ones_stay_finite():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [5, 5, 5]])
    moved = denoised(vertices, torch.tensor([[0, 1, 2], [0, 1, 3]], dtype=torch.int32), 1.0)
    np.testing.assert_allclose(moved.numpy(), vertices.numpy(), atol=1e-12)
    assert len(denoised(vertices[:0], torch.zeros(0, 3, dtype=torch.int32), 1.0)) == 0


def test_faces_beyond_edges():
    faces = torch.tensor([[0, 1, 2], [2, 1, 3], [1, 3, 4]])
    assert faces_beyond(faces).tolist() == [[0, 1, 0], [0, 2, 1], [1, 2, 2]]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_the_same():
    vertices, faces = _roof(0.1)
    there = denoised(vertices.cuda(), faces.cuda(), 0.1).cpu()
    torch.testing.assert_close(there, denoised(vertices, faces, 0.1), rtol=0, atol=1e-9)
