"""Small surfaces whose distances are known."""

import numpy as np

from geogs.evaluation.surfaces.surface import Surface
from geogs.geometry.camera import Camera
from geogs.mesh.triangle_mesh import Mesh

CAMERA = Camera(fx=100.0, fy=100.0, cx=79.5, cy=59.5, width=160, height=120)
NO_FACES = np.zeros((0, 3), np.int64)


def plane(z: float, half: float = 1.0, cells: int = 4) -> Surface:
    """A square at depth z."""
    g = np.linspace(-half, half, cells + 1)
    x, y = np.meshgrid(g, g, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], -1)
    i = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    a, b, c, d = i, i + 1, i + cells + 1, i + cells + 2
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])
    return Surface(vertices, faces)


def joined(*parts: Surface) -> Surface:
    """The surfaces in one mesh."""
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    faces = np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)])
    return Surface(np.concatenate([p.vertices for p in parts]), faces)


def moved(surface: Surface, x: float, y: float, z: float) -> Surface:
    """The surface, shifted."""
    return Surface(surface.vertices + np.array([x, y, z]), surface.faces)


def hills(n: int = 60) -> Mesh:
    """A square with a bump in the middle; sides are straight, half of it is flat."""
    line = np.linspace(-1, 1, n)
    y, x = np.meshgrid(line, line, indexing="ij")
    z = 0.3 * np.exp(-8 * (x**2 + y**2))
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([
        np.stack([corner, corner + 1, corner + n], -1),
        np.stack([corner + 1, corner + n + 1, corner + n], -1),
    ])  # fmt: skip
    mesh = Mesh.from_triangles(np.stack([x, y, z], -1).reshape(-1, 3), faces)
    colours = np.stack([127 * (x + 1), 127 * (y + 1), 0 * x], -1).reshape(-1, 3)
    return Mesh(mesh.vertices, mesh.faces, mesh.normals, colours.astype(np.uint8))
