"""From depth maps to normals."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.camera import Camera


def normals_from_depth(
    depth: Float[Tensor, "h w"], camera: Camera
) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]:
    """Unit normals from central differences of the back-projected points.

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
