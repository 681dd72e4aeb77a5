"""The baseline with colour: the same images, the same seconds, its own folder."""

import importlib.util
import json
import time
from pathlib import Path

import numpy as np
import torch

from geogs.application.run_settings import ReconstructSettings
from geogs.config import MeshConfig
from geogs.errors import DeviceError, InputError
from geogs.extras import install_command
from geogs.gpu.installation import require_device
from geogs.guard.atomic import prepare_output_folder, write_text
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.sources.sniff import open_posed_source
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.mesh.extract import extract_mesh
from geogs.mesh.triangle_mesh import Mesh
from geogs.types import Trajectory
from geogs_bench.appearance.appearance_config import AppearanceConfig
from geogs_bench.appearance.appearance_disks import AppearanceDisks
from geogs_bench.appearance.appearance_trainer import AppearanceResult, AppearanceTrainer
from geogs_bench.appearance.rasteriser import GsplatRasteriser, depth_views
from geogs_bench.appearance.training_views import TrainingView, training_views
from geogs_photos.start_points import StartPoints, find_start_points

_BUDGET = 120.0
"""Default training time in seconds; start points and mesh come on top."""


def require_packages() -> None:
    """Raise InputError if the packages that train the baseline are not installed."""
    for needed in ("gsplat", "pycolmap"):
        if importlib.util.find_spec(needed) is None:
            raise InputError(f"the baseline with colour needs {needed}: {install_command('bench')}")


def train_baseline(settings: ReconstructSettings) -> None:
    """2D Gaussian splatting with colour, by gsplat: start points, training, mesh.

    The settings of the disk map have no effect, and of its mesh only the voxels.

    Raises:
        InputError: the source cannot be read, or has too little texture.
        DeviceError: there is no NVIDIA GPU, or its memory is full.
    """
    assert settings.output is not None, "a task has a folder"
    device = require_device(settings.device)
    config = settings.config
    if device.type != "cuda":
        raise DeviceError("the baseline with colour needs an NVIDIA GPU.")
    source = open_posed_source(settings.source, config.input, settings.hold_out)
    views = training_views(source)
    start = time.perf_counter()
    points = find_start_points(views, config.seed)
    seconds = {"start points": time.perf_counter() - start}
    output = prepare_output_folder(settings.output)
    result, mesh = _train(output, settings, views, points, str(device), seconds)
    _write(output, source, result, mesh)
    summary = {
        "source": source.name,
        "kind": source.kind,
        "frames": len(views),
        "held_out": list(source.held_out),
        "start_points": len(points),
        "disks": len(result.disks),
        "map_bytes": result.disks.bytes,
        "mesh_faces": len(mesh.faces),
        "iterations": result.iterations,
        "psnr": result.psnr,
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "device": torch.cuda.get_device_name(device),
        "peak_gpu_memory_bytes": torch.cuda.max_memory_allocated(device),
        "seed": config.seed,
    }
    write_text(output / "summary.json", json.dumps(summary, indent=2))


def _train(
    output: Path,
    settings: ReconstructSettings,
    views: list[TrainingView],
    points: StartPoints,
    device: str,
    seconds: dict[str, float],
) -> tuple[AppearanceResult, Mesh]:
    """Train, and write a mesh at each snapshot; the times of both parts go into ``seconds``.

    Meshes are made by the same fusion as the system's own maps.
    """
    config = AppearanceConfig()
    given = settings.config
    surface = MeshConfig(voxel=given.mesh.voxel, truncation=given.mesh.truncation)
    rasteriser = GsplatRasteriser(config.near)

    def meshed(disks: AppearanceDisks) -> Mesh:
        return extract_mesh(depth_views(disks, views, rasteriser, config), surface)

    def snapshot(at: float, disks: AppearanceDisks) -> None:
        folder = prepare_output_folder(output / "snapshots" / f"{at:g}")
        meshed(disks).save(folder / "mesh.ply")

    trainer = AppearanceTrainer(
        views, points.positions, points.colours, rasteriser, config, given.seed, device
    )
    try:
        result = trainer.train(settings.budget or _BUDGET, settings.snapshots, snapshot)
    except torch.cuda.OutOfMemoryError as error:
        raise DeviceError(
            "The memory of the GPU is full; use fewer or smaller images for the baseline."
        ) from error
    seconds["training"] = result.seconds
    start = time.perf_counter()
    mesh = meshed(result.disks)
    seconds["mesh"] = time.perf_counter() - start
    return result, mesh


def _write(output: Path, source: PosedSource, result: AppearanceResult, mesh: Mesh) -> None:
    mesh.save(output / "mesh.ply")
    write_intrinsics(output / "intrinsics.json", source.camera, None)
    T_wc = np.linalg.inv(source.T_cw)
    poses = Trajectory(source.timestamps, T_wc, np.ones(len(T_wc), bool))
    write_tum_trajectory(output / "trajectory.tum", poses)
