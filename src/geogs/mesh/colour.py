"""Vertex colours from the images of the views."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.lie import transform
from geogs.geometry.neighbors import nearest_neighbors
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.threads import on_one_torch_thread, thread_map

GREY = 128
"""Level of the colour of a surface that no view shows."""
SLACK = 0.02
"""Fraction of the depth by which a vertex may be off a view's depth, besides the tolerance."""
LEAST_COSINE = 0.05
"""Cosine of the viewing angle above which a view sees a face's front."""
_SPAN = 32768
"""Vertices that a thread of the CPU takes at a time."""


@on_one_torch_thread
def colour_mesh(mesh: Mesh, views: Sequence[DepthMapView], tolerance: float) -> Mesh:
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
            add(view, tolerance, vertices, normals, total, weight)
        if progress:
            progress(number + 1, len(views))
    return total / torch.where(weight > 0, weight, 1.0)[:, None], weight > 0


def add_reference(
    view: DepthMapView,
    tolerance: float,
    vertices: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    total: Float[Tensor, "n 3"],
    weight: Float[Tensor, "n"],
) -> None:
    """Add the weighted colours that a view gives, and their weights, in place: on any device."""
    camera = view.camera
    T_cw = view.T_cw.to(vertices)
    points = transform(T_cw, vertices)
    pixels, z = camera.project(points)
    column, row = pixels.round().long().unbind(-1)
    inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    index = inside.nonzero()[:, 0]
    depth = _depth(view).to(vertices.device)[row[index], column[index]]
    z = z[index]
    on_surface = (depth - z).abs() < tolerance + SLACK * z
    index = index[on_surface]
    z = z[on_surface]
    ray = torch.nn.functional.normalize(points[index], dim=-1)
    cosine = -(ray * (normals[index] @ T_cw[:3, :3].mT)).sum(-1)
    front = cosine > LEAST_COSINE
    index = index[front]
    gain = (cosine[front] / z[front]) ** 2
    image = torch.from_numpy(view.rgb()).to(vertices.device).permute(2, 0, 1).float()
    total.index_add_(0, index, gain[:, None] * _sample(image, camera, pixels[index]))
    weight.index_add_(0, index, gain)


def add_compiled(
    view: DepthMapView,
    tolerance: float,
    vertices: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    total: Float[Tensor, "n 3"],
    weight: Float[Tensor, "n"],
) -> None:
    """:func:`add_reference` by compiled loops, for float32 tensors on the CPU."""
    from geogs.mesh.colour_kernels import add_colours

    count = len(vertices)
    camera = view.camera
    T = view.T_cw.to(vertices)[:3]
    places, facing, pose, depth = (
        np.ascontiguousarray(x.cpu().numpy(), np.float32)
        for x in (vertices, normals, T, _depth(view))
    )
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    reach = np.float32(tolerance)
    slack = np.float32(SLACK)
    least = np.float32(LEAST_COSINE)
    image = np.ascontiguousarray(view.rgb())
    sums = total.numpy()
    weights = weight.numpy()

    def some(start: int) -> None:
        end = min(start + _SPAN, count)
        add_colours(
            start, end, places, facing, pose, lens, depth, image, reach, slack, least, sums, weights
        )

    thread_map(some, range(0, count, _SPAN))


def _depth(view: DepthMapView) -> Float[Tensor, "h w"]:
    """Depth of a view; infinite where unknown."""
    return torch.where(view.valid(), view.depth, torch.inf)


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
        return torch.full_like(colours, GREY)
    _, nearest = nearest_neighbors(vertices[~seen], vertices[seen], 1)
    colours[~seen] = colours[seen][nearest[:, 0]]
    return colours
