"""Normals of single pixels of a depth map, from planes fitted to the depths around."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.jumps import minmod_slopes

_REACHES = (0.06, 0.03, 0.02)
"""Relative difference of inverse depths beyond which a pixel is on another surface, round by round:
slopes of single pixels, from which the first starts, are noisy."""
_LEAST_SHARE = 0.3
"""Least fraction of the weight around a pixel that its plane has to explain."""
_LEAST_WEIGHT = 2.0
"""Least weight that it has to explain: three pixels would fit any noise."""
_RIDGE = 1e-6
"""Regularises the plane of pixels that lie on one line."""


def fitted_normals(
    depth: Float[Tensor, "h w"],
    weight: Float[Tensor, "h w"],
    camera: Camera,
    pixels: tuple[Int[Tensor, "n"], Int[Tensor, "n"]],
    radius: int,
) -> Float[Tensor, "n 3"]:
    """Compute unit normals at some pixels (rows, columns), each of a plane fitted to nearby depths.

    Inverse depth is linear in u and v along a plane, so a fit over pixels is as good on slanted
    surfaces as on those facing the camera; nearest neighbours in space would lie along one image
    row there. Pixels within ``radius`` count by their ``weight``, those without depth (0) not at
    all. Normals are in the camera's frame and face the camera; they are zero where no plane
    explains three tenths of the weight around, or more than two pixels.
    """
    v, u = pixels
    inverse = torch.where(depth > 0, 1 / depth.clamp(min=1e-9), 0.0)
    own = inverse[v, u].clamp(min=1e-9)
    steps = torch.arange(-radius, radius + 1, device=depth.device)
    dv, du = (x.flatten() for x in torch.meshgrid(steps, steps, indexing="ij"))
    rows, columns = v[:, None] + dv, u[:, None] + du
    inside = (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
    there = rows.clamp(0, camera.height - 1), columns.clamp(0, camera.width - 1)
    counts = weight[there] * (inside & (depth[there] > 0))
    right, down = (slope[v, u] / own for slope in minmod_slopes(inverse, depth > 0))
    first = torch.stack([right, down, torch.ones_like(own)], -1)
    offsets = torch.stack([du, dv, torch.ones_like(du)], -1).to(depth)
    plane, is_plane = _robust_planes(inverse[there] / own[:, None], counts, offsets, first)
    a, b = plane[:, 0] * camera.fx, plane[:, 1] * camera.fy
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    away = torch.stack([a, b, plane[:, 2] - a * x - b * y], -1)
    return torch.where(is_plane[:, None], -torch.nn.functional.normalize(away, dim=-1), 0.0)


def _robust_planes(
    values: Float[Tensor, "n k"],
    counts: Float[Tensor, "n k"],
    offsets: Float[Tensor, "k 3"],
    plane: Float[Tensor, "n 3"],
) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Fit planes ``offsets @ plane`` to inverse depths relative to the pixel's own, near 1, by
    reweighted least squares (Tukey's biweight); return them and whether they explain enough."""
    products = (offsets[:, :, None] * offsets[:, None]).flatten(1)
    ridge = _RIDGE * torch.eye(3, dtype=values.dtype, device=values.device)
    total = counts.sum(1)
    is_plane = torch.zeros_like(total, dtype=torch.bool)
    for reach in _REACHES:
        error = (values - plane @ offsets.mT) / reach
        fit = counts * (1 - error.square()).clamp(min=0).square()
        explained = fit.sum(1)
        is_plane = (explained > _LEAST_SHARE * total) & (explained > _LEAST_WEIGHT)
        system = (fit @ products).unflatten(1, (3, 3)) + ridge
        # No check of its errors, which would wait for a GPU.
        solution, _ = torch.linalg.solve_ex(system, (fit * values) @ offsets)
        plane = torch.where(is_plane[:, None], solution, plane)
    return plane, is_plane
