"""Depth maps of surfaces: their normals, and their averages over tangent planes."""

from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.jumps import JUMP
from geogs.gpu.kernels import kernels_for

_SOURCE = Path(__file__).parent / "cuda" / "depth.cu"
_BLOCK = (32, 8)
_LEAST_REACH = 1e-6
"""Least reach; below it pixels differ by rounding alone, and nothing would be averaged."""
_ROUNDS = 2


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
    top, total = torch.zeros_like(inverse), torch.zeros_like(inverse)
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
