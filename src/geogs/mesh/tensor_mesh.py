"""Meshes as tensors, on the device where they were made."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_FACES_AT_ONCE = 2**17
"""Faces processed in float64 at a time; bounds memory."""


@dataclass(frozen=True)
class TensorMesh:
    """Triangles in the world frame; faces turn counter-clockwise seen from free space."""

    vertices: Float[Tensor, "n 3"]
    """Positions, float32, map units."""
    faces: Int[Tensor, "m 3"]
    """Vertices of each face, int64."""

    @staticmethod
    def of(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> "TensorMesh":
        """The mesh of arrays, copied."""
        return TensorMesh(
            torch.from_numpy(np.array(vertices, order="C")),
            torch.from_numpy(np.array(faces, np.int64, order="C")),
        )

    def normals(self) -> Float[Tensor, "n 3"]:
        """Unit normals in float32, the mean of a vertex's faces weighted by area."""
        total = self.vertices.new_zeros(self.vertices.shape, dtype=torch.float64)
        for faces, u, v in self.sides():
            add_at_corners(total, torch.linalg.cross(u, v), faces)
        return torch.nn.functional.normalize(total, dim=-1, eps=1e-300).float()

    def sides(self) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Some faces at a time, with their sides from the first corner to the second and to the
        third, float64."""
        for faces in self.faces.split(_FACES_AT_ONCE):
            a, b, c = self.vertices[faces].double().unbind(1)
            yield faces, b - a, c - a

    def kept(self, keep: Bool[Tensor, "m"]) -> "TensorMesh":
        """Some of the faces and the vertices that they use."""
        faces = self.faces[keep]
        used = torch.zeros(len(self.vertices), dtype=torch.bool, device=faces.device)
        used[faces.flatten()] = True
        return TensorMesh(self.vertices[used], (used.cumsum(0) - 1)[faces])


def vertex_sums(
    values: Float[Tensor, "m k"], faces: Int[Tensor, "m 3"], count: int
) -> Float[Tensor, "n k"]:
    """Sum of the faces' values at each of ``count`` vertices."""
    total = values.new_zeros(count, values.shape[1])
    add_at_corners(total, values, faces)
    return total


def add_at_corners(
    total: Float[Tensor, "n k"], values: Float[Tensor, "m k"], faces: Int[Tensor, "m 3"]
) -> None:
    """Add the faces' values to their corners' totals."""
    for corner in faces.unbind(1):
        total.index_add_(0, corner, values)
