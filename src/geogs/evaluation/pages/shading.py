"""Pictures of meshes without a graphics library."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from geogs.evaluation.held_camera import level_axes, look_at_one_place
from geogs.evaluation.surfaces.raster import render_mesh
from geogs.geometry.camera import Camera
from geogs.geometry.creases import creased

GREY = 190
"""Level of surfaces without a colour."""
_AMBIENT = 0.25
_WIDTH = 480
"""Width of a picture, pixels."""


@dataclass(frozen=True)
class Viewpoint:
    """A view of a mesh."""

    name: str
    camera: Camera
    T_cw: Float[np.ndarray, "4 4"]
    ceiling: float | None = None
    """Height (along ``up``) above which faces are left out."""
    up: Float[np.ndarray, "3"] | None = None


@dataclass(frozen=True)
class Sight:
    """Hits of the rays of a view: 2 x 2 rays a pixel."""

    hit: Bool[np.ndarray, "fine_h fine_w"]
    corners: Int[np.ndarray, "k 3"]
    """Vertices of the face that each hitting ray meets."""
    light: Float[np.ndarray, "k 1"]
    """Brightness there, in [0, 1]."""

    def paint(self, colours: UInt8[np.ndarray, "n 3"] | None = None) -> UInt8[np.ndarray, "h w 3"]:
        """The picture (RGB): faces grey, or in the mean colour of their vertices."""
        picture = np.full((*self.hit.shape, 3), 255.0)
        colour = np.full((1, 3), float(GREY))
        if colours is not None:
            colour = colours[self.corners].astype(np.float64).mean(1)
        picture[self.hit] = self.light * colour
        height, width = self.hit.shape[0] // 2, self.hit.shape[1] // 2
        return picture.reshape(height, 2, width, 2, 3).mean((1, 3)).round().astype(np.uint8)


def look(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], view: Viewpoint
) -> Sight:
    """Shade a mesh with a lamp at the camera: brightness is the cosine to its normal, which is
    smooth except at edges.

    Both sides of a face are seen, as true meshes often have no orientation.
    """
    vertices = vertices.astype(np.float64)
    if view.ceiling is not None and view.up is not None and len(faces):
        height = (vertices @ view.up)[faces].mean(1)
        faces = faces[height < view.ceiling]
    camera = view.camera
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    if not len(faces):
        hit = np.zeros((fine.height, fine.width), bool)
        return Sight(hit, np.zeros((0, 3), np.int64), np.zeros((0, 1)))
    depth, face = render_mesh(vertices, faces, fine, view.T_cw)
    hit = face >= 0
    corners = faces[face[hit]]
    smooth = creased(vertices, faces)
    points = vertices @ view.T_cw[:3, :3].T + view.T_cw[:3, 3]
    ray = fine.rays().numpy()[hit].astype(np.float64)
    weights = _barycentric(points[corners], depth[hit][:, None] * ray)
    normal = (weights[:, :, None] * smooth.normals[smooth.faces[face[hit]]]).sum(1)
    normal = normal @ view.T_cw[:3, :3].T
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-300
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    light = _AMBIENT + (1 - _AMBIENT) * np.abs((normal * ray).sum(1, keepdims=True))
    return Sight(hit, corners, light)


def _barycentric(
    corners: Float[np.ndarray, "k 3 3"], points: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "k 3"]:
    """Barycentric coordinates of points of triangles."""
    a, b, c = (corners[:, i] for i in range(3))
    area = np.cross(b - a, c - a)
    whole = (area * area).sum(1) + 1e-300
    second = (np.cross(points - a, c - a) * area).sum(1) / whole
    third = (np.cross(b - a, points - a) * area).sum(1) / whole
    return np.stack([1 - second - third, second, third], 1).clip(0, 1)


def viewpoints(
    vertices: Float[np.ndarray, "n 3"],
    T_wc: Float[np.ndarray, "k 4 4"],
    camera: Camera,
    up: Float[np.ndarray, "3"] | None = None,
) -> list[Viewpoint]:
    """Views from the first and the middle camera, and from above without the ceiling.

    If all cameras look at one point, as at an object, the third is the camera with the largest
    rotation from the other two. ``up`` of the world is the cameras' where it is not given.
    """
    inside = camera.with_long_edge(_WIDTH)
    chosen = {"first frame": T_wc[0], "middle frame": T_wc[len(T_wc) // 2]}
    around = look_at_one_place(T_wc)
    if around:
        cosine = T_wc[:, :3, 2] @ T_wc[[0, len(T_wc) // 2], :3, 2].T
        chosen["another side"] = T_wc[cosine.max(1).argmin()]
    views = [Viewpoint(name, inside, np.linalg.inv(T)) for name, T in chosen.items()]
    if around:
        return views
    return [*views, _from_above(vertices, T_wc, level_axes(T_wc, up), _WIDTH, inside.height)]


def _from_above(
    vertices: Float[np.ndarray, "n 3"],
    T_wc: Float[np.ndarray, "k 4 4"],
    axes: Float[np.ndarray, "3 3"],
    width: int,
    height: int,
) -> Viewpoint:
    """View with nearly parallel rays from far above; all above the cameras is cut away."""
    local = vertices.astype(np.float64) @ axes.T
    low, high = np.quantile(local, [0.005, 0.995], axis=0)
    extent = np.maximum(high - low, 1e-6)
    far = 30 * float(extent.max())
    focal = 0.95 * far * min(width / extent[0], height / extent[1])
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    T_cw = np.eye(4)
    T_cw[:3, :3] = np.stack([axes[0], -axes[1], -axes[2]])
    centre = axes.T @ np.array([*(low + high)[:2] / 2, high[2] + far])
    T_cw[:3, 3] = -T_cw[:3, :3] @ centre
    ceiling = float(np.median(T_wc[:, :3, 3] @ axes[2]))
    return Viewpoint("from above", camera, T_cw, ceiling, axes[2])
