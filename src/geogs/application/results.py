"""Everything a run leaves in its folder."""

import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch

import geogs
from geogs.application.progress import RunProgress, peak_memory
from geogs.application.surfaces import fusion_views, write_surface
from geogs.config import Config, ReconstructConfig
from geogs.evaluation import plots
from geogs.evaluation.run_report import write_run_page
from geogs.evaluation.shading import viewpoints
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.several import SeveralSources, SourceSpan
from geogs.io.sources.sniff import Stream
from geogs.io.writers.atomic import write_text
from geogs.io.writers.intrinsics import write_intrinsics
from geogs.io.writers.native import save_map
from geogs.io.writers.ply import write_splats
from geogs.io.writers.tum import write_tum_trajectory
from geogs.mesh.colour import colour_mesh
from geogs.mesh.types import DepthMapView, Mesh
from geogs.stopwatch import Stopwatch
from geogs.types import MapSnapshot, RenderedKeyframe, Trajectory


@runtime_checkable
class MappedScene(Protocol):
    """What has a trajectory, disks and depth maps to write."""

    stopwatch: Stopwatch

    @property
    def frames(self) -> int:
        """Images so far."""
        ...

    def trajectory(self) -> Trajectory:
        """Poses of all frames."""
        ...

    def keyframe_trajectory(self) -> Trajectory:
        """Poses of the keyframes alone."""
        ...

    def snapshot(self) -> MapSnapshot:
        """The disks."""
        ...

    def renders(self) -> Sequence[RenderedKeyframe]:
        """The map seen from every keyframe."""
        ...

    def depth_maps(self) -> Sequence[RenderedKeyframe]:
        """The keyframes' depths as searched."""
        ...

    def particulars(self) -> Mapping[str, object]:
        """What else the summary says, ready for JSON."""
        ...


@dataclass(frozen=True)
class SourceFacts:
    """What the results say of the source."""

    name: str
    kind: str
    camera: Camera
    intrinsics_origin: str
    calibration: Calibration | None = None
    """Of the images as they came; none where each may have its own."""
    skipped: int = 0
    scale: str = "arbitrary (monocular)"
    """What a unit of the map is."""
    held_out: tuple[int, ...] = ()
    """Images that were not used: their places in the source without start and stride."""
    videos: tuple[SourceSpan, ...] = ()
    """Where each begins, if there are several."""

    @staticmethod
    def of(source: Stream) -> "SourceFacts":
        """Of a source that was read to its end."""
        return SourceFacts(
            source.name, source.kind, source.camera, source.intrinsics_origin,
            source.calibration, source.skipped,
            videos=tuple(source.spans) if isinstance(source, SeveralSources) else (),
        )  # fmt: skip


def write_results(
    output: Path,
    slam: MappedScene,
    source: SourceFacts,
    config: Config | ReconstructConfig,
    interrupted: bool,
    progress: RunProgress,
    more: Sequence[Callable[[], None]] = (),
) -> None:
    """Write poses first, then the map, the mesh, what else was asked for, and the report on them.

    ``more`` writes the rest, which the summary then counts.
    """
    trajectory = slam.trajectory()
    write_tum_trajectory(output / "trajectory.tum", trajectory)
    keyframes = slam.keyframe_trajectory()
    write_tum_trajectory(output / "keyframes.tum", keyframes)
    write_intrinsics(output / "intrinsics.json", source.camera, source.calibration)
    write_config(output / "config.yaml", config)
    disks = slam.snapshot()
    save_map(output / "map.safetensors", disks, {"source": source.name, "seed": config.seed})
    renders = slam.renders()
    if len(disks):
        write_splats(output / "splats.ply", disks, splat_colours(disks, fusion_views(renders)))
    with slam.stopwatch("mesh"):
        mesh = write_surface(output / "mesh.ply", renders, config.mesh, progress)
    for write in more:
        write()
    lost = int((~trajectory.tracked).sum())
    if lost > 0.2 * slam.frames:
        progress.write(
            f"warning: {lost} of {slam.frames} frames were not tracked; slower motion, texture "
            "or the right --intrinsics may help."
        )
    summary = summarise(slam, source, trajectory, keyframes, disks, mesh, config, interrupted)
    write_text(output / "summary.json", json.dumps(summary, indent=2))
    with slam.stopwatch("report"):
        write_report(output / "report", trajectory, renders, mesh, summary)


def write_config(path: Path, config: Config | ReconstructConfig) -> None:
    """All settings as YAML."""
    import yaml

    plain = json.loads(json.dumps(asdict(config), default=str))
    write_text(path, yaml.safe_dump(plain, sort_keys=False))


def splat_colours(disks: MapSnapshot, views: Sequence[DepthMapView]) -> np.ndarray:
    """RGB in [0, 1] of every disk, from the images that see it; the map itself has no colour."""
    points = Mesh(
        disks.position.cpu().numpy(), np.zeros((0, 3), np.int32), disks.normal.cpu().numpy()
    )
    tolerance = 4 * float(disks.scale.median())
    colours = colour_mesh(points, views, tolerance).colours
    return np.full((len(disks), 3), 0.5) if colours is None else colours / 255.0


def summarise(
    slam: MappedScene,
    source: SourceFacts,
    trajectory: Trajectory,
    keyframes: Trajectory,
    disks: MapSnapshot,
    mesh: Mesh | None,
    config: Config | ReconstructConfig,
    interrupted: bool,
) -> dict[str, object]:
    """What happened, in numbers."""
    seconds = {name: round(s, 3) for name, s in slam.stopwatch.seconds.items()}
    total = sum(seconds.values())
    online = sum(seconds.get(k, 0.0) for k in ("tracking", "mapping", "pose refinement"))
    rates = {"with_final_stages": round(slam.frames / max(total, 1e-9), 3)}
    if online:
        rates = {"online": round(slam.frames / online, 3), **rates}
    return {
        "source": source.name,
        "kind": source.kind,
        "frames": slam.frames,
        "skipped_images": source.skipped,
        **({"held_out": list(source.held_out)} if source.held_out else {}),
        "keyframes": len(keyframes.timestamps),
        "lost_spans": lost_spans(trajectory),
        **slam.particulars(),
        **({"videos": [asdict(v) for v in source.videos]} if source.videos else {}),
        "disks": len(disks),
        "mesh_faces": 0 if mesh is None else len(mesh.faces),
        "seconds": {**seconds, "total": round(total, 3)},
        "frames_per_second": rates,
        "peak_memory_bytes": peak_memory(),
        **device_summary(disks.position.device),
        "interrupted": interrupted,
        "intrinsics": source.intrinsics_origin,
        "scale": source.scale,
        "seed": config.seed,
        "versions": {
            "geogs": geogs.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
    }


def device_summary(device: torch.device) -> dict[str, object]:
    """What the map was trained on, and a GPU's memory at its fullest (PyTorch's tensors)."""
    if device.type != "cuda":
        return {"device": "cpu"}
    name = torch.cuda.get_device_name(device)
    return {"device": name, "peak_gpu_memory_bytes": torch.cuda.max_memory_allocated(device)}


def lost_spans(trajectory: Trajectory) -> list[list[float]]:
    """First and last time of every stretch where the camera was lost."""
    lost = np.concatenate([[False], ~trajectory.tracked, [False]]).astype(int)
    first, last = np.flatnonzero(np.diff(lost) == 1), np.flatnonzero(np.diff(lost) == -1) - 1
    times = trajectory.timestamps
    return [[float(times[a]), float(times[b])] for a, b in zip(first, last, strict=True)]


def write_report(
    folder: Path,
    trajectory: Trajectory,
    renders: Sequence[RenderedKeyframe],
    mesh: Mesh | None,
    summary: dict[str, object],
) -> None:
    """A page with what needs no ground truth: path, renders beside images, shaded mesh, numbers."""
    folder.mkdir(exist_ok=True)
    plots.plot_path(folder / "trajectory.png", trajectory)
    if renders:
        shown = [renders[i] for i in np.linspace(0, len(renders) - 1, min(5, len(renders))).round()
                 .astype(int)]  # fmt: skip
        plots.plot_keyframes(
            folder / "keyframes.png",
            [r.image for r in shown],
            [r.depth.cpu().numpy() for r in shown],
            [r.normal.cpu().numpy() for r in shown],
        )
    if mesh is not None:
        views = viewpoints(mesh.vertices, trajectory.T_wc[trajectory.tracked], renders[0].camera)
        surface = [("mesh", mesh.vertices, mesh.faces, None)]
        coloured = [("colours", mesh.vertices, mesh.faces, mesh.colours)]
        plots.plot_meshes(
            folder / "mesh.png", surface + (coloured if mesh.colours is not None else []), views
        )
    write_run_page(folder, summary)
