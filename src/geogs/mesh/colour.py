"""Vertex colours from the images of the views."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.lie import transform
from geogs.geometry.neighbors import nearest_neighbors
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.threads import on_one_torch_thread, thread_map

_GREY = 128
SLACK = 0.02
"""Fraction of the depth by which a vertex may be off a view's depth, besides the tolerance."""
LEAST_COSINE = 0.05
"""Cosine of the viewing angle above which a view sees a face's front."""
_SPAN = 32768
"""Vertices that a thread of the CPU takes at a time."""


@on_one_torch_thread
def colour_mesh(
    mesh: Mesh,
    views: Sequence[DepthMapView],
    tolerance: float,
) -> Mesh:
    """Give each vertex the mean colour of the images that see it, by :func:`seen_colours`.

    A vertex that no view sees takes the colour of the nearest one that is seen, grey if there is
    none. Computed on the device of the first depth map.
    """
    device = views[0].depth.device if len(views) else torch.device("cpu")
    vertices = torch.from_numpy(mesh.vertices).to(device)
    normals = torch.from_numpy(mesh.normals).to(device)
    mean, seen = seen_colours(vertices, normals, views, tolerance)
    return replace(mesh, colours=filled(vertices, mean, seen).cpu().numpy())


def seen_colours(
    vertices: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    views: Sequence[DepthMapView],
    tolerance: float,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Mean colours (0 to 255) of vertices in the images that see them, and which are seen.

    A view sees a vertex that projects into the image onto its depth map within ``tolerance``
    (map units, plus 2 % of the depth) and turns its front to the camera. Views are weighted by
    (cosine of the viewing angle / depth)^2: near and frontal ones decide.
    """
    total = torch.zeros_like(vertices)
    weight = torch.zeros(len(vertices), device=vertices.device)
    compiled = vertices.device.type == "cpu" and vertices.dtype == torch.float32
    add = add_compiled if compiled else add_reference
    for number, view in enumerate(views):
        if view.image is not None:
            add(_SeenImage.of(view, tolerance, vertices), vertices, normals, total, weight)
        if progress:
            progress(number + 1, len(views))
    return total / torch.where(weight > 0, weight, 1.0)[:, None], weight > 0


def add_reference(
    seen: "_SeenImage",
    vertices: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    total: Float[Tensor, "n 3"],
    weight: Float[Tensor, "n"],
) -> None:
    """Add the weighted colours that a view gives, and their weights, in place: on any device."""
    index, w, colour = seen.observe(vertices, normals)
    total.index_add_(0, index, w[:, None] * colour)
    weight.index_add_(0, index, w)


def add_compiled(
    seen: "_SeenImage",
    vertices: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    total: Float[Tensor, "n 3"],
    weight: Float[Tensor, "n"],
) -> None:
    """:func:`add_reference` by compiled loops, for float32 tensors on the CPU."""
    from geogs.mesh.colour_kernels import add_colours

    f, camera, n = np.float32, seen.camera, len(vertices)
    T = np.ascontiguousarray(seen.T_cw.numpy()[:3], np.float32)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    places, facing, depth = (
        np.ascontiguousarray(x.numpy(), np.float32) for x in (vertices, normals, seen.depth)
    )
    image, sums, weights = np.ascontiguousarray(seen.image), total.numpy(), weight.numpy()

    def some(start: int) -> None:
        add_colours(
            start, min(start + _SPAN, n), places, facing, T, lens, depth, image,
            f(seen.tolerance), f(SLACK), f(LEAST_COSINE), sums, weights,
        )  # fmt: skip

    thread_map(some, range(0, n, _SPAN))


@dataclass(frozen=True)
class _SeenImage:
    """A view that gives colours, on the device of the vertices."""

    camera: Camera
    T_cw: Float[Tensor, "4 4"]
    depth: Float[Tensor, "h w"]
    """Depth; infinite where unknown."""
    image: UInt8[np.ndarray, "ih iw 3"]
    tolerance: float

    @staticmethod
    def of(view: DepthMapView, tolerance: float, vertices: Tensor) -> "_SeenImage":
        depth = torch.where(view.valid(), view.depth, torch.inf).to(vertices.device)
        return _SeenImage(view.camera, view.T_cw.to(vertices), depth, view.rgb(), tolerance)

    def observe(
        self, vertices: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]
    ) -> tuple[Tensor, Float[Tensor, "k"], Float[Tensor, "k 3"]]:
        """Indices, weights and colours (0 to 255) of the vertices that the view sees."""
        points = transform(self.T_cw, vertices)
        pixels, z = self.camera.project(points)
        column, row = pixels.round().long().unbind(-1)
        width, height = self.camera.width, self.camera.height
        inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        index = inside.nonzero()[:, 0]
        depth, z = self.depth[row[index], column[index]], z[index]
        on_surface = (depth - z).abs() < self.tolerance + SLACK * z
        index, z = index[on_surface], z[on_surface]
        ray = torch.nn.functional.normalize(points[index], dim=-1)
        cosine = -(ray * (normals[index] @ self.T_cw[:3, :3].mT)).sum(-1)
        front = cosine > LEAST_COSINE
        index, weight = index[front], (cosine[front] / z[front]) ** 2
        image = torch.from_numpy(self.image).to(vertices.device).permute(2, 0, 1).float()
        return index, weight, _sample(image, self.camera, pixels[index])


def _sample(
    image: Float[Tensor, "3 ih iw"], camera: Camera, pixels: Float[Tensor, "k 2"]
) -> Float[Tensor, "k 3"]:
    """Bilinear samples of an image at pixels of the depth map of its view."""
    height, width = image.shape[1:]
    scale = pixels.new_tensor([width / camera.width, height / camera.height])
    pixels = (pixels + 0.5) * scale - 0.5
    grid = 2 * pixels / pixels.new_tensor([max(width - 1, 1), max(height - 1, 1)]) - 1
    samples = torch.nn.functional.grid_sample(
        image[None], grid[None, None], padding_mode="border", align_corners=True
    )
    return samples[0, :, 0].mT


def filled(
    vertices: Float[Tensor, "n 3"], mean: Float[Tensor, "n 3"], seen: Bool[Tensor, "n"]
) -> UInt8[Tensor, "n 3"]:
    """Colours as bytes; a vertex that no view sees takes that of the nearest seen one."""
    colours = (mean + 0.5).clamp(0, 255).to(torch.uint8)
    if bool(seen.all()):
        return colours
    if not bool(seen.any()):
        return torch.full_like(colours, _GREY)
    _, nearest = nearest_neighbors(vertices[~seen], vertices[seen], 1)
    colours[~seen] = colours[seen][nearest[:, 0]]
    return colours
