"""Vertex colours from the images of the views."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.geometry.lie import transform
from geogs.geometry.neighbors import nearest_neighbors
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.threads import on_one_torch_thread

_GREY = 128


@on_one_torch_thread
def colour_mesh(
    mesh: Mesh,
    views: Sequence[DepthMapView],
    tolerance: float,
    progress: Callable[[int, int], None] | None = None,
) -> Mesh:
    """Give each vertex the mean colour of the images that see it.

    A view sees a vertex that projects into the image onto its depth map within ``tolerance``
    (map units, plus 2 % of the depth) and turns its front to the camera. Views count by
    (cosine of the viewing angle / depth)^2: near and frontal ones decide. A vertex that no view
    sees takes the colour of the nearest one that is seen, grey if there is none. Computed on the
    device of the first depth map.
    """
    device = views[0].depth.device if len(views) else torch.device("cpu")
    vertices = torch.from_numpy(mesh.vertices).to(device)
    normals = torch.from_numpy(mesh.normals).to(device)
    total = torch.zeros_like(vertices)
    weight = torch.zeros(len(vertices), device=device)
    for number, view in enumerate(views):
        if view.image is not None:
            index, w, colour = _observe(vertices, normals, view, tolerance)
            total.index_add_(0, index, w[:, None] * colour)
            weight.index_add_(0, index, w)
        if progress:
            progress(number + 1, len(views))
    seen = weight > 0
    mean = total / torch.where(seen, weight, 1.0)[:, None]
    colours = (mean + 0.5).clamp(0, 255).to(torch.uint8)
    return replace(mesh, colours=_fill(vertices, colours, seen).cpu().numpy())


def _observe(
    vertices: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    view: DepthMapView,
    tolerance: float,
) -> tuple[Tensor, Float[Tensor, "k"], Float[Tensor, "k 3"]]:
    """Indices, weights and colours (0 to 255) of the vertices that a view sees."""
    T_cw = view.T_cw.to(vertices)
    points = transform(T_cw, vertices)
    pixels, z = view.camera.project(points)
    column, row = pixels.round().long().unbind(-1)
    width, height = view.camera.width, view.camera.height
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = inside.nonzero()[:, 0]
    place = row[index], column[index]
    depth = torch.where(view.valid(), view.depth, torch.inf).to(vertices.device)
    on_surface = (depth[place] - z[index]).abs() < tolerance + 0.02 * z[index]
    index = index[on_surface]
    ray = torch.nn.functional.normalize(points[index], dim=-1)
    cosine = -(ray * (normals[index] @ T_cw[:3, :3].mT)).sum(-1)
    front = cosine > 0.05
    index, cosine = index[front], cosine[front]
    return index, (cosine / z[index]) ** 2, _sample(view, pixels[index])


def _sample(view: DepthMapView, pixels: Float[Tensor, "k 2"]) -> Float[Tensor, "k 3"]:
    """Bilinear samples of the view's image at pixels of its depth map."""
    image = torch.from_numpy(view.rgb()).to(pixels.device).permute(2, 0, 1).float()
    height, width = image.shape[1:]
    scale = pixels.new_tensor([width / view.camera.width, height / view.camera.height])
    pixels = (pixels + 0.5) * scale - 0.5
    grid = 2 * pixels / pixels.new_tensor([max(width - 1, 1), max(height - 1, 1)]) - 1
    samples = torch.nn.functional.grid_sample(
        image[None], grid[None, None], padding_mode="border", align_corners=True
    )
    return samples[0, :, 0].mT


def _fill(
    vertices: Float[Tensor, "n 3"], colours: UInt8[Tensor, "n 3"], seen: Bool[Tensor, "n"]
) -> UInt8[Tensor, "n 3"]:
    """Unseen vertices in the colour of the nearest seen one."""
    if bool(seen.all()):
        return colours
    if not bool(seen.any()):
        return torch.full_like(colours, _GREY)
    _, nearest = nearest_neighbors(vertices[~seen], vertices[seen], 1)
    colours[~seen] = colours[seen][nearest[:, 0]]
    return colours
