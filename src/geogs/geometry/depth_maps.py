"""Depth maps of surfaces: normals by differences or fitted planes, averages over tangent planes."""

from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.jumps import JUMP, minmod_slopes
from geogs.gpu.kernels import kernels_for

_SOURCE = Path(__file__).parent / "cuda" / "depth.cu"
_BLOCK = (32, 8)
_LEAST_REACH = 1e-6
"""Least reach; below it pixels differ by rounding alone, and nothing would be averaged."""
_ROUNDS = 2
_REACHES = (0.06, 0.03, 0.02)
"""Relative difference of inverse depths beyond which a pixel is on another surface, round by round:
slopes of single pixels, from which the first starts, are noisy."""
_LEAST_SHARE = 0.3
"""Least fraction of the weight around a pixel that its plane has to explain."""
_LEAST_WEIGHT = 2.0
"""Least weight that it has to explain: three pixels would fit any noise."""


def normals_from_depth(
    depth: Float[Tensor, "h w"], camera: Camera
) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]:
    """Compute unit normals from central differences of the back-projected points.

    The cross product is (right - left) x (top - bottom), so normals face the camera: the paper's
    Eq. depth_normal with the sign that makes its normal consistency zero at agreement. Valid where
    the pixel and its four neighbours have positive depth; the border ring is invalid and zero.
    """
    p = camera.back_project(depth)
    horizontal = p[1:-1, 2:] - p[1:-1, :-2]
    vertical = p[:-2, 1:-1] - p[2:, 1:-1]
    d = depth > 0
    inner = d[1:-1, 1:-1] & d[1:-1, 2:] & d[1:-1, :-2] & d[2:, 1:-1] & d[:-2, 1:-1]
    # In holes the product may be zero, where normalising it has no finite slope.
    n = torch.where(inner[..., None], torch.linalg.cross(horizontal, vertical), 1.0)
    n = n * (n.square().sum(-1, keepdim=True) + 1e-30).rsqrt()
    normals = torch.nn.functional.pad(n * inner[..., None], (0, 0, 1, 1, 1, 1))
    return normals, torch.nn.functional.pad(inner, (1, 1, 1, 1))


def averaged_over_planes(
    depth: Float[Tensor, "h w"],
    normal: Float[Tensor, "h w 3"],
    camera: Camera,
    radius: int,
    reach: float,
) -> Float[Tensor, "h w"]:
    """Smooth depth by averaging over the tangent planes of the pixels around.

    The plane through a pixel q with normal n has the inverse depth ``(n . r_p) / (z_q n . r_q)`` on
    the ray of any pixel p, which is linear in p. A pixel gets the mean of these values over the
    pixels within ``radius``, itself included, each weighted by ``(1 - (e / reach)^2)^2`` (Tukey's
    biweight), where e is its relative difference from the pixel's old value, and zero beyond
    ``reach`` or ``JUMP``. So planes do not change, however slanted, and steps stay steps. Pixels
    without depth, and those seen at less than six degrees, do not change and are not used.
    """
    if reach < _LEAST_REACH:
        return depth
    reach = min(reach, JUMP)
    slope = (normal * camera.rays(depth.dtype, depth.device)).sum(-1)
    good = (depth > 0) & (slope.abs() > 0.1)
    inverse = torch.where(good, 1 / depth.clamp(min=1e-9), 0.0)
    # Slope of the inverse depth over its own value, per pixel to the right and down.
    tilt = [
        normal[..., k] / slope.where(good, 1.0) / f for k, f in enumerate((camera.fx, camera.fy))
    ]
    one_round = averaged_once_on_gpu if depth.device.type == "cuda" else averaged_once
    for _ in range(_ROUNDS):
        right, down = (inverse * t for t in tilt)
        inverse = torch.where(good, one_round(inverse, right, down, radius, reach), 0.0)
    return torch.where(good, 1 / inverse.clamp(min=1e-9), depth)


def averaged_once(
    inverse: Float[Tensor, "h w"],
    right: Float[Tensor, "h w"],
    down: Float[Tensor, "h w"],
    radius: int,
    reach: float,
) -> Float[Tensor, "h w"]:
    """Run one round of :func:`averaged_over_planes` on inverse depths, zero where there is none,
    and the slopes of their planes per pixel to the right and down. Zero where no pixel contributes.
    """
    height, width = inverse.shape
    before = torch.where(inverse > 0, 1 / inverse.clamp(min=1e-9), 0.0)
    top = torch.zeros_like(inverse)
    total = torch.zeros_like(inverse)
    for dy in range(-radius, radius + 1):
        above = inverse - dy * down
        for dx in range(-radius, radius + 1):
            here, there = _shifted(height, dy), _shifted(width, dx)
            p, q = (here[0], there[0]), (here[1], there[1])
            said = (above - dx * right)[q]
            # Where either has no depth, e is -1 and the weight is zero.
            e = (said * before[p]).sub_(1)
            weight = e.square_().mul_(-1 / reach**2).add_(1).clamp_(min=0).square_()
            top[p].addcmul_(weight, said)
            total[p].add_(weight)
    return top / total.clamp(min=1e-9)


def averaged_once_on_gpu(
    inverse: Float[Tensor, "h w"],
    right: Float[Tensor, "h w"],
    down: Float[Tensor, "h w"],
    radius: int,
    reach: float,
) -> Float[Tensor, "h w"]:
    """Do the same by a CUDA kernel, in float32."""
    height, width = inverse.shape
    averaged = torch.empty_like(inverse)
    grid = (-(-width // _BLOCK[0]), -(-height // _BLOCK[1]))
    kernel = kernels_for(_SOURCE, inverse.device)["average_planes"]
    kernel(grid, _BLOCK, inverse, right, down, height, width, radius, reach, averaged)
    return averaged


def _shifted(size: int, by: int) -> tuple[slice, slice]:
    """Return the positions that have a neighbour ``by`` farther on, and those neighbours."""
    return slice(max(0, -by), size - max(0, by)), slice(max(0, by), size - max(0, -by))


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
    # Regularises the plane of pixels that lie on one line.
    ridge = 1e-6 * torch.eye(3, dtype=values.dtype, device=values.device)
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
