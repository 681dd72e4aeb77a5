"""Vertex colours: who sees a vertex, and how views are mixed."""

import numpy as np
import torch

from geogs.geometry.camera import Camera
from geogs.mesh.colour import add_compiled, add_reference, colour_mesh
from geogs.mesh.triangle_mesh import DepthMapView, Mesh

CAMERA = Camera(fx=50.0, fy=50.0, cx=31.5, cy=23.5, width=64, height=48)


def wall(z: float, half: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    """A square facing a camera that looks along z."""
    x, y = np.meshgrid(np.linspace(-half, half, 9), np.linspace(-half, half, 9))
    vertices = np.stack([x.ravel(), y.ravel(), np.full(81, z)], -1).astype(np.float32)
    i = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    faces = np.concatenate([np.stack([i, i + 9, i + 1], -1), np.stack([i + 1, i + 9, i + 10], -1)])
    return vertices, faces.astype(np.int32)


def view(depth: float, colour: tuple[int, int, int], shift: float = 0.0) -> DepthMapView:
    z = torch.full((48, 64), depth)
    T = torch.eye(4, dtype=torch.float64)
    T[2, 3] = shift
    image = np.full((96, 128, 3), colour, np.uint8)
    return DepthMapView(z, torch.ones_like(z), CAMERA, T, image)


def test_hidden_vertices_take_no_colour_from_the_view():
    front, faces = wall(1.0)
    back, _ = wall(2.0)
    mesh = Mesh.from_triangles(np.concatenate([front, back]), np.concatenate([faces, faces + 81]))
    colours = colour_mesh(mesh, [view(1.0, (10, 20, 30))], 0.02).colours
    assert (colours[:81] == (10, 20, 30)).all()
    seen = colour_mesh(mesh, [view(1.0, (10, 20, 30)), view(2.0, (90, 80, 70))], 0.02).colours
    assert (seen[81:] == (90, 80, 70)).all()


def test_near_views_count_more():
    vertices, faces = wall(1.0)
    mesh = Mesh.from_triangles(vertices, faces)
    near, far = view(1.0, (200, 0, 0)), view(2.0, (0, 0, 200), shift=1.0)
    colours = colour_mesh(mesh, [near, far], 0.02).colours.astype(float)
    middle = colours[40]  # the middle vertex: weights 1 and 1/4
    assert np.abs(middle - [160, 0, 40]).max() <= 1


def test_back_faces_and_empty_views_give_grey():
    vertices, faces = wall(1.0)
    mesh = Mesh.from_triangles(vertices, faces[:, ::-1])
    assert (colour_mesh(mesh, [view(1.0, (10, 20, 30))], 0.02).colours == 128).all()


def test_image_of_another_size_lands_on_its_pixels():
    """Left half red, right half blue; the border lies between pixels 31 and 32."""
    vertices, faces = wall(1.0)
    v = view(1.0, (0, 0, 0))
    image = np.zeros((96, 128, 3), np.uint8)
    image[:, :64, 0], image[:, 64:, 2] = 255, 255
    v = DepthMapView(v.depth, v.weight, v.camera, v.T_cw, image)
    colours = colour_mesh(Mesh.from_triangles(vertices, faces), [v], 0.02).colours
    left, right = vertices[:, 0] < -0.02, vertices[:, 0] > 0.02
    assert (colours[left] == (255, 0, 0)).all()
    assert (colours[right] == (0, 0, 255)).all()
    middle = colours[np.abs(vertices[:, 0]) < 1e-6]
    assert np.abs(middle.astype(int) - [128, 0, 128]).max() <= 1


def test_compiled_colours_are_those_of_the_definition():
    random = np.random.default_rng(0)
    n = 20000
    vertices = torch.from_numpy(random.uniform(-1.5, 1.5, (n, 3)).astype(np.float32))
    vertices[:, 2] = torch.from_numpy(random.uniform(-0.5, 2.0, n).astype(np.float32))
    normals = torch.nn.functional.normalize(torch.from_numpy(random.normal(size=(n, 3))).float())
    depth = torch.from_numpy(random.uniform(0.8, 1.6, (48, 64)).astype(np.float32))
    image = random.integers(0, 256, (96, 128, 3), np.uint8)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.tensor([0.1, -0.05, 0.2])
    seen = DepthMapView(depth, torch.ones_like(depth), CAMERA, T, image)
    found = []
    for add in (add_reference, add_compiled):
        total, weight = torch.zeros(n, 3), torch.zeros(n)
        add(seen, 0.2, vertices, normals, total, weight)
        found.append((total, weight))
    (total, weight), (compiled_total, compiled_weight) = found
    assert int((weight > 0).sum()) > 100
    torch.testing.assert_close(compiled_weight, weight, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(compiled_total, total, rtol=1e-3, atol=1e-2)
