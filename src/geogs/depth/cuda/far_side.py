"""The farther surface beside each pixel, on a GPU."""

from pathlib import Path

import torch
from jaxtyping import Float32
from torch import Tensor

from geogs.gpu.kernels import kernels_for

SOURCE = Path(__file__).with_name("far_side.cu")


def farther_planes(
    planes: Float32[Tensor, "3 h w"], near_share: float, reach: int
) -> Float32[Tensor, "h w"]:
    """Inverse depth of the planes gone on to each pixel from within ``reach`` of it, 0 where there
    is none: as ``geogs.depth.far_side.farther_surface``."""
    height, width = planes.shape[1:]
    found = torch.zeros_like(planes)
    age = torch.zeros(height, width, dtype=torch.int32, device=planes.device)
    farthest = planes[0].amin()
    kernel = kernels_for(SOURCE, planes.device)["farther_planes"]
    tiles = -(-width // 32), -(-height // 4)
    for round in range(1, reach + 1):
        kernel(tiles, (32, 4), planes, farthest, near_share, round, height, width, found, age)
    return found[0]
