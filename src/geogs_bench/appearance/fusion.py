"""The baseline's depth maps, in the form in which the system's own maps are meshed."""

from collections.abc import Sequence

import torch

from geogs.mesh.triangle_mesh import DepthMapView
from geogs_bench.appearance.config import AppearanceConfig
from geogs_bench.appearance.depth import crossing_depth
from geogs_bench.appearance.disks import AppearanceDisks
from geogs_bench.appearance.rasteriser import Rasteriser
from geogs_bench.appearance.views import TrainingView


@torch.no_grad()
def depth_views(
    disks: AppearanceDisks,
    views: Sequence[TrainingView],
    rasteriser: Rasteriser,
    config: AppearanceConfig,
) -> list[DepthMapView]:
    """Depth of every view inside its mask; every pixel with a depth has weight 1."""
    device = disks.means.device
    maps = []
    for view in views:
        T_cw = torch.from_numpy(view.T_cw).float().to(device)
        median = rasteriser.median_disks(disks, view.camera, T_cw)
        depth = crossing_depth(disks, median, view.camera, T_cw, config.min_alpha)
        if view.mask is not None:
            depth = torch.where(torch.from_numpy(view.mask).to(device), depth, 0.0)
        weight = (depth > 0).float()
        T_cw_exact = torch.from_numpy(view.T_cw)
        maps.append(DepthMapView(depth, weight, view.camera, T_cw_exact, view.image))
    return maps
