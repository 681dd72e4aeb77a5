"""The baseline from images to mesh, in three calls: points, training, mesh."""

from collections.abc import Sequence

import torch

from geogs.config import MeshConfig
from geogs.errors import DeviceError
from geogs.mesh.extract import extract_mesh
from geogs.mesh.triangle_mesh import Mesh
from geogs_bench.appearance.config import AppearanceConfig
from geogs_bench.appearance.disks import AppearanceDisks
from geogs_bench.appearance.fusion import depth_views
from geogs_bench.appearance.gsplat_rasteriser import GsplatRasteriser
from geogs_bench.appearance.start_points import StartPoints
from geogs_bench.appearance.trainer import AppearanceResult, AppearanceTrainer, OnTime
from geogs_bench.appearance.views import TrainingView


def train_appearance(
    views: Sequence[TrainingView],
    points: StartPoints,
    budget: float,
    config: AppearanceConfig | None = None,
    seed: int = 0,
    device: str = "cuda",
    at_seconds: Sequence[float] = (),
    on_time: OnTime | None = None,
) -> AppearanceResult:
    """Train on the GPU for ``budget`` seconds.

    ``on_time(seconds, disks)`` is called at each of ``at_seconds`` while the clock stands still.

    Raises:
        InputError: gsplat is not installed, or there are too few points.
        DeviceError: there is no GPU, or its memory is full.
    """
    config = config or AppearanceConfig()
    rasteriser = GsplatRasteriser(config.near)
    trainer = AppearanceTrainer(
        views, points.positions, points.colours, rasteriser, config, seed, device
    )
    try:
        return trainer.train(budget, at_seconds, on_time)
    except torch.cuda.OutOfMemoryError as error:
        raise DeviceError(
            "The memory of the GPU is full; use fewer or smaller images for the baseline."
        ) from error


def appearance_mesh(
    disks: AppearanceDisks,
    views: Sequence[TrainingView],
    mesh: MeshConfig | None = None,
    config: AppearanceConfig | None = None,
) -> Mesh:
    """The surface of the baseline's disks, by the same fusion as the system's own maps.

    Raises:
        InputError: gsplat is not installed, or there is no surface.
        DeviceError: there is no GPU.
    """
    config = config or AppearanceConfig()
    rasteriser = GsplatRasteriser(config.near)
    return extract_mesh(depth_views(disks, views, rasteriser, config), mesh)
