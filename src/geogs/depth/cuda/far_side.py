"""The farther surface beside each pixel, on a GPU."""

from pathlib import Path

import torch
from jaxtyping import Float32
from torch import Tensor

from geogs.depth.revision.far_side import MIN_GAP, as_depth, inverse_planes
from geogs.gpu.kernels import kernels_for

SOURCE = Path(__file__).with_name("far_side.cu")


def farther_surface(depth: Float32[Tensor, "h w"], reach: int) -> Float32[Tensor, "h w"]:
    """As :func:`geogs.depth.revision.far_side.farther_surface`."""
    planes = inverse_planes(depth)
    height, width = depth.shape
    found = torch.zeros_like(planes)
    age = torch.zeros(height, width, dtype=torch.int32, device=depth.device)
    farthest = planes[0].amin()
    kernel = kernels_for(SOURCE, depth.device)["farther_planes"]
    tiles = -(-width // 32), -(-height // 4)
    for round in range(1, reach + 1):
        kernel(tiles, (32, 4), planes, farthest, 1 - MIN_GAP, round, height, width, found, age)
    return as_depth(found[0])
