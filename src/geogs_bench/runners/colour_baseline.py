"""Runs the baseline with colour as a task: the same images, the same seconds, its own folder."""

import importlib.util
import json
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geogs.config import InputConfig, MeshConfig
from geogs.errors import DeviceError, InputError
from geogs.io.writers.atomic import prepare_output_folder, write_text
from geogs_bench.runners.runner import Task

if TYPE_CHECKING:
    from geogs.io.sources.posed.posed_source import PosedSource
    from geogs.mesh.triangle_mesh import Mesh
    from geogs_bench.appearance.appearance_disks import AppearanceDisks
    from geogs_bench.appearance.appearance_trainer import AppearanceResult
    from geogs_bench.appearance.start_points import StartPoints
    from geogs_bench.appearance.training_views import TrainingView


@dataclass(frozen=True)
class BaselineSettings:
    """What of a task's options concerns the baseline; those of the disk map do not."""

    budget: float = 120.0
    """Seconds of training; start points and mesh come on top."""
    seed: int = 0
    device: str = "auto"
    hold_out: int | None = None
    """Every so many-th image is not used; none uses all."""
    snapshots: tuple[float, ...] = ()
    """Seconds after which the mesh is written as it is then."""
    input: InputConfig = field(default_factory=InputConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)


class BaselineRunner:
    """2D Gaussian splatting with colour, by gsplat, on an NVIDIA GPU."""

    def settings(self, task: Task) -> dict[str, object]:
        """What concerns the baseline. Raises InputError if gsplat is missing or a value wrong."""
        for needed in ("gsplat", "pycolmap"):
            if importlib.util.find_spec(needed) is None:
                raise InputError(
                    f"the baseline with colour needs {needed}: pip install 'geogs[bench]'."
                )
        return asdict(settings_of(task))

    def run(self, task: Task) -> None:
        """Start points, training, mesh.

        Raises:
            InputError: the source cannot be read, or has too little texture.
            DeviceError: there is no GPU, or its memory is full.
        """
        import torch

        from geogs.gpu.installation import require_device
        from geogs.io.sources.sniff import open_posed_source
        from geogs_bench.appearance.start_points import find_start_points
        from geogs_bench.appearance.training_views import training_views

        settings = settings_of(task)
        device = require_device(settings.device)
        if device.type != "cuda":
            raise DeviceError("the baseline with colour needs an NVIDIA GPU.")
        source = open_posed_source(task.source, settings.input, settings.hold_out)
        views = training_views(source)
        start = time.perf_counter()
        points = find_start_points(views, settings.seed)
        seconds = {"start points": time.perf_counter() - start}
        output = prepare_output_folder(task.output)
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
            "seed": settings.seed,
        }
        write_text(output / "summary.json", json.dumps(summary, indent=2))


def settings_of(task: Task) -> BaselineSettings:
    """Read a task's options. Raises InputError if a value is no number."""
    try:
        return BaselineSettings(
            float((task.option("budget") or "120").removesuffix("s")),
            int(task.option("seed") or 0),
            task.option("device") or "auto",
            int(every) if (every := task.option("hold-out")) else None,
            tuple(float(s) for s in (task.option("snapshots") or "").split(",") if s),
            InputConfig(
                intrinsics=task.option("input.intrinsics") or "auto",
                long_edge=int(task.option("input.long-edge") or InputConfig.long_edge),
                stride=int(task.option("input.stride") or 1),
            ),
            MeshConfig(
                voxel=_number(task.option("mesh.voxel")),
                truncation=_number(task.option("mesh.truncation")) or MeshConfig.truncation,
            ),
        )
    except ValueError:
        raise InputError("an option of the baseline that has to be a number is none.") from None


def _train(
    output: Path,
    settings: BaselineSettings,
    views: "list[TrainingView]",
    points: "StartPoints",
    device: str,
    seconds: dict[str, float],
) -> "tuple[AppearanceResult, Mesh]":
    """Train, writing a mesh at each snapshot; the seconds of both parts go into ``seconds``.

    Meshes are made by the same fusion as the system's own maps.
    """
    import torch

    from geogs.mesh.extract import extract_mesh
    from geogs_bench.appearance.appearance_config import AppearanceConfig
    from geogs_bench.appearance.appearance_trainer import AppearanceTrainer
    from geogs_bench.appearance.crossing_depth import depth_views
    from geogs_bench.appearance.gsplat_rasteriser import GsplatRasteriser

    config = AppearanceConfig()
    rasteriser = GsplatRasteriser(config.near)

    def meshed(disks: "AppearanceDisks") -> "Mesh":
        return extract_mesh(depth_views(disks, views, rasteriser, config), settings.mesh)

    def snapshot(at: float, disks: "AppearanceDisks") -> None:
        folder = prepare_output_folder(output / "snapshots" / f"{at:g}")
        _write_mesh(folder / "mesh.ply", meshed(disks))

    trainer = AppearanceTrainer(
        views, points.positions, points.colours, rasteriser, config, settings.seed, device
    )
    try:
        result = trainer.train(settings.budget, settings.snapshots, snapshot)
    except torch.cuda.OutOfMemoryError as error:
        raise DeviceError(
            "The memory of the GPU is full; use fewer or smaller images for the baseline."
        ) from error
    seconds["training"] = result.seconds
    start = time.perf_counter()
    mesh = meshed(result.disks)
    seconds["mesh"] = time.perf_counter() - start
    return result, mesh


def _write(output: Path, source: "PosedSource", result: "AppearanceResult", mesh: "Mesh") -> None:
    from geogs.io.writers.intrinsics_file import write_intrinsics
    from geogs.io.writers.trajectories import write_tum_trajectory
    from geogs.types import Trajectory

    _write_mesh(output / "mesh.ply", mesh)
    write_intrinsics(output / "intrinsics.json", source.camera, None)
    T_wc = np.linalg.inv(source.T_cw)
    poses = Trajectory(source.timestamps, T_wc, np.ones(len(T_wc), bool))
    write_tum_trajectory(output / "trajectory.tum", poses)


def _write_mesh(path: Path, mesh: "Mesh") -> None:
    from geogs.io.writers.ply_writer import write_mesh

    write_mesh(path, mesh.vertices, mesh.faces, mesh.colours, mesh.normals)


def _number(text: str | None) -> float | None:
    return None if text is None else float(text)
