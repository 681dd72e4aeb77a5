"""Cuts of a mesh by a plane, and the floor of a room."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from geogs.mesh.triangle_mesh import Mesh


@dataclass(frozen=True)
class Cut:
    """Lines in which a plane cuts a mesh, in coordinates of the plane."""

    ends: Float[np.ndarray, "k 2 2"]
    """Both ends of each line."""
    inward: Float[np.ndarray, "k 2"]
    """Unit normals of the lines, towards free space."""

    @property
    def lengths(self) -> Float[np.ndarray, "k"]:
        """Lengths of the lines."""
        return np.asarray(np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1))

    def part(self, keep: Bool[np.ndarray, "k"]) -> "Cut":
        """Some of the lines."""
        return Cut(self.ends[keep], self.inward[keep])


def cut_mesh(mesh: Mesh, axis: int, at: float) -> Cut:
    """Cut a mesh by a plane at right angles to one of its axes.

    Args:
        mesh: the surface.
        axis: 0, 1 or 2: the axis; the plane has the other two, in their order.
        at: coordinate of the plane along it.
    """
    beyond = mesh.vertices[:, axis].astype(np.float64) - at
    beyond[beyond == 0] = 1e-12  # no corner lies in the plane
    above = (beyond > 0)[mesh.faces]
    crossed = mesh.faces[above.any(1) & ~above.all(1)].astype(np.int64)
    above = (beyond > 0)[crossed]
    # The corner that is alone on its side comes first; the order of the others stays.
    alone = np.where(above.sum(1) == 1, above.argmax(1), above.argmin(1))
    turned = np.take_along_axis(crossed, (alone[:, None] + np.arange(3)) % 3, 1)
    corners = mesh.vertices[turned].astype(np.float64)
    first, second, third = beyond[turned].T
    fractions = np.stack([first / (first - second), first / (first - third)], 1)
    points = corners[:, :1] + fractions[..., None] * (corners[:, 1:] - corners[:, :1])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across = [a for a in range(3) if a != axis]
    ends = points[..., across]
    along = ends[:, 1] - ends[:, 0]
    lengths = np.linalg.norm(along, axis=1)
    inward = np.stack([-along[:, 1], along[:, 0]], 1) / np.maximum(lengths, 1e-12)[:, None]
    inward *= np.where((inward * normals[:, across]).sum(1) < 0, -1.0, 1.0)[:, None]
    return Cut(ends, inward).part(lengths > 1e-9 * max(float(lengths.max(initial=0.0)), 1e-12))


def heights(mesh: Mesh) -> tuple[float, float]:
    """Heights of the floor and of the top of a mesh whose z axis points up.

    The floor is the lowest of the large level parts that face up; outliers are left out.
    """
    low, high = np.quantile(mesh.vertices[:, 2], [0.005, 0.995])
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    double = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(double, axis=1)
    is_level = double[:, 2] > np.cos(np.radians(20)) * area
    centres = corners[is_level, :, 2].mean(1)
    found, edges = np.histogram(centres, 100, (low, high), weights=area[is_level])
    around = np.convolve(found, np.ones(3), "same")
    # A tenth of the level area is a floor, and not the top of a thing below it.
    is_floor = around > 0.1 * max(float(found.sum()), 1e-300)
    if not is_floor.any():
        return float(low), float(high)
    lowest = int(is_floor.argmax())
    peak = lowest + int(around[lowest : lowest + 3].argmax())
    return float((edges[peak] + edges[peak + 1]) / 2), float(high)
