"""The edge-aware correction of ``edges.py`` on a GPU."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from geogs.depth import edges as cpu
from geogs.depth.cuda.plane_sweep import SweptDepth
from geogs.depth.cuda.refinement import SlantedMaps
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import upload

SOURCE = Path(__file__).with_name("edges.cu")


def resolve_edges(
    refined: SlantedMaps,
    confidence: Float32[Tensor, "h w"],
    colours: Float32[Tensor, "3 h w"],
    swept: SweptDepth,
) -> tuple[SlantedMaps, Float32[Tensor, "h w"]]:
    """As ``geogs.depth.edges.resolve_edges``; ``colours`` is the image in [0, 1]."""
    h, w = confidence.shape
    planes = swept.planes
    constants = (cpu.CONTRAST, cpu.MIN_GAP, cpu.WIDTH, cpu.COST_TRUST, cpu.MOVED_CONFIDENCE)
    settings = upload(np.array(constants, np.float32), confidence.device)
    maps = [refined.inverse_depth, refined.slope_x, refined.slope_y, confidence]
    for _ in range(cpu.PASSES):
        out = [torch.empty_like(confidence) for _ in maps]
        kernels_for(SOURCE, confidence.device)["resolve_edges"](
            (-(-w // 32), -(-h // 4)), (32, 4), *maps, colours, swept.costs, settings, planes.per,
            planes.count, planes.first, planes.spacing, cpu.reach_of((h, w)), cpu.MEAN_SHIFTS, h, w,
            *out,
        )  # fmt: skip
        maps = out
    rho, slope_x, slope_y, confidence = maps
    return SlantedMaps(rho, slope_x, slope_y, refined.support), confidence
