"""Choice of the depth estimator: on the CPU, or on the GPU that holds the map."""

import torch

from geogs.config import DepthConfig
from geogs.depth.depth_engine import DepthEngine
from geogs.depth.revision.revised_searches import FarSideSearch, SkySearch
from geogs.geometry.camera import Camera


def depth_engine(
    device: torch.device | str, render: Camera, working: Camera, config: DepthConfig, resident: int
) -> DepthEngine:
    """The engine that the settings name for a map on ``device``: depths at the size of ``render``,
    from images at the size of ``working``, of which a GPU holds the ``resident`` used last.

    Raises InputError if the network is chosen and its weights are not found or do not fit.
    """
    device = torch.device(device)
    engine = config.engine
    if device.type == "cuda":
        from geogs.depth.cuda.classical import CudaDepthEngine

        classical = FarSideSearch(CudaDepthEngine(device, render, working, resident, config.planes))
    else:
        from geogs.depth.classical import CpuDepthEngine

        classical = FarSideSearch(CpuDepthEngine(render, working, config.planes))
    if engine == "auto":
        engine = "joint" if device.type == "cuda" else "classical"
    if engine == "classical":
        return SkySearch(classical)
    if engine == "tracker":
        from geogs.depth.tracker_depth import TrackerDepthEngine

        return TrackerDepthEngine(classical, device, render, working)
    from geogs.depth.network.engine import NetworkDepthEngine
    from geogs.depth.network.model import load_depth_network
    from geogs.networks.weights_files import find_weights

    trained = load_depth_network(find_weights("depth", config.weights))
    network = NetworkDepthEngine(trained, classical, device, render, working, resident)
    if engine == "network":
        return SkySearch(network)
    from geogs.depth.network.engine import JointDepthEngine

    return SkySearch(JointDepthEngine(network, classical))
