"""Where keyframe depths are computed: on the CPU, or on the GPU that holds the map."""

import torch

from geogs.config import DepthConfig
from geogs.depth.base import DepthEngine
from geogs.geometry.camera import Camera


def depth_engine(
    device: torch.device | str,
    render: Camera,
    working: Camera,
    config: DepthConfig,
    resident: int,
) -> DepthEngine:
    """The engine for a map on ``device``: depths at the size of ``render``, refined at that of
    ``working``, the size of the keyframes' images, of which a GPU holds the ``resident`` used last.
    """
    if torch.device(device).type == "cuda":
        from geogs.depth.cuda.engine import CudaDepthEngine

        return CudaDepthEngine(torch.device(device), render, working, config, resident)
    from geogs.depth.classical import CpuDepthEngine

    return CpuDepthEngine(render, working, config)
