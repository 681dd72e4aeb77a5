"""Mesh files: of the result, of earlier stages, of depths without disks, and a preview."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

from geogs.application.progress.run_progress import RunProgress
from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.guard.replacement import replaced
from geogs.io.writers.map_file import save_map
from geogs.io.writers.trajectories import write_trajectories
from geogs.mesh.colour import colour_mesh
from geogs.mesh.extract import extract_mesh
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.on_demand import OnDemand
from geogs.threads import on_one_torch_thread
from geogs.types import MapSnapshot, RenderedKeyframe

if TYPE_CHECKING:
    from geogs.application.results.mapped_scene import MappedScene
    from geogs.reconstruction import Reconstruction
    from geogs.slam import Slam
    from geogs.world.keyframes import Keyframe


PREVIEW = "preview.ply"


def fusion_views(renders: Sequence[RenderedKeyframe]) -> Sequence[DepthMapView]:
    """The renderings as input of mesh extraction, each made on demand."""
    return OnDemand(renders, lambda r: DepthMapView(r.depth, r.weight, r.camera, r.T_cw, r.image))


def fused(
    renders: Sequence[RenderedKeyframe],
    config: MeshConfig,
    progress: RunProgress,
    name: str = "mesh",
) -> Mesh:
    """Fuse depth maps to a mesh, called ``name``. Raises InputError where there is no surface."""
    return extract_mesh(
        fusion_views(renders),
        config,
        lambda part, done, of: progress.stage(f"{name}: {part}", done / of),
    )


def surface_of(
    renders: Sequence[RenderedKeyframe],
    config: MeshConfig,
    progress: RunProgress,
    name: str = "mesh",
) -> Mesh | None:
    """Fuse depth maps to a mesh; without a surface, a message names it ``name``."""
    try:
        return fused(renders, config, progress, name)
    except InputError as error:
        progress.write(f"No {name}: {error}")
        return None


def write_surface(
    path: Path,
    renders: Sequence[RenderedKeyframe],
    config: MeshConfig,
    progress: RunProgress,
    name: str = "mesh",
) -> Mesh | None:
    """Fuse depth maps to a mesh and write that, if there is a surface.

    Raises:
        OutputError: the file cannot be written.
    """
    mesh = surface_of(renders, config, progress, name)
    if mesh is not None:
        mesh.save(path)
    return mesh


def write_depth_mesh(output: Path, scene: "MappedScene", progress: RunProgress) -> None:
    """Write ``depth_fusion/mesh.ply``, the surface of the searched depths, for comparison."""
    with scene.stopwatch("depth fusion"):
        path = output / "depth_fusion" / "mesh.ply"
        write_surface(path, scene.depth_maps(), scene.config.mesh, progress, "depth mesh")


def write_stage(
    output: Path, scene: "MappedScene", progress: RunProgress, name: Literal["online", "adjusted"]
) -> None:
    """Write the present trajectories and mesh to a folder of the stage's name.

    ``online`` is the end of the stream, ``adjusted`` the state after the final bundle adjustment
    and the map's update.
    """
    with scene.stopwatch(f"{name} results"):
        folder = output / name
        write_trajectories(folder, scene.trajectory(), scene.keyframe_trajectory())
        path = folder / "mesh.ply"
        write_surface(path, scene.renders(), scene.config.mesh, progress, f"{name} mesh")


def splat_colours(disks: MapSnapshot, views: Sequence[DepthMapView]) -> np.ndarray:
    """RGB in [0, 1] of every disk, from the images that see it; the map itself has no colour."""
    points = Mesh(
        disks.position.cpu().numpy(), np.zeros((0, 3), np.int32), disks.normal.cpu().numpy()
    )
    tolerance = 4 * float(disks.scale.median())
    colours = colour_mesh(points, views, tolerance).colours
    return np.full((len(disks), 3), 0.5) if colours is None else colours / 255.0


class Snapshots:
    """Copies of the disks at the first progress report after each of the given times.

    Times are in seconds, from the end of reading. Nothing is written meanwhile.
    """

    def __init__(self, seconds: Sequence[float]) -> None:
        self._due = sorted(set(seconds))
        self._kept: dict[float, MapSnapshot] = {}
        self._early: list[float] = []

    def take(self, scene: "Reconstruction") -> None:
        """Copy the disks if a time has passed; without disks yet there is no copy."""
        while self._due and scene.elapsed >= self._due[0]:
            disks = scene.snapshot()
            seconds = self._due.pop(0)
            if len(disks):
                self._kept[seconds] = disks
            else:
                self._early.append(seconds)

    def write(self, output: Path, scene: "Reconstruction", progress: RunProgress) -> None:
        """Write ``snapshots/<seconds>/{map.safetensors, mesh.ply}`` for each copy.

        Raises:
            OutputError: a file cannot be written.
        """
        for seconds in self._early:
            progress.write(f"No snapshot after {seconds:g} s: there was no map yet.")
        for seconds, disks in self._kept.items():
            folder = output / "snapshots" / f"{seconds:g}"
            with scene.stopwatch("snapshots"):
                save_map(folder / "map.safetensors", disks, {"seconds": seconds})
                name = f"mesh at {seconds:g} s"
                renders = scene.renders(disks)
                write_surface(folder / "mesh.ply", renders, scene.config.mesh, progress, name)


def write_preview(output: Path, slam: "Slam") -> bool:
    """Write ``preview.ply``: the surface of the depths of tracking.

    It is deleted when the final result is written. Returns whether there is one.

    Raises:
        OutputError: the file cannot be written.
    """
    mesh = preview(slam)
    if mesh is None:
        return False
    with replaced(output, "part") as new:
        mesh.save(new / PREVIEW)
    return True


@on_one_torch_thread
def preview(slam: "Slam") -> Mesh | None:
    """The surface of the depths of tracking, one per 64 pixels; none without any."""
    keyframes = slam.segments.main.segment.keyframes
    stride = -(-max(len(keyframes), 1) // 60)  # at most 60 views, evenly spread
    camera = slam.camera
    # A cell of the tracker has eight pixels, so 128 along the longer side show all of it.
    shrink = min(128 / max(camera.width, camera.height), 1.0)
    small = camera.resized(round(shrink * camera.width), round(shrink * camera.height))
    views = OnDemand(list(keyframes)[::stride], lambda k: _view(k, camera, small))
    # One such coarse depth alone makes no surface: a voxel needs more weight than one view gives.
    rough = replace(slam.config.mesh, voxel=None, triangle_budget=60_000, min_weight=1.5)
    try:
        return extract_mesh(views, rough)
    except InputError:  # too little surface is known; the full map may have more
        return None


def _view(keyframe: "Keyframe", working: Camera, small: Camera) -> DepthMapView:
    from geogs.depth.tracker_depth import enlarged_depth  # loads SciPy, seldom needed

    found = enlarged_depth(*keyframe.depth_field(), working, small)
    depth, weight = (torch.from_numpy(m) for m in (found.depth, found.confidence))
    return DepthMapView(depth, weight, small, keyframe.T_cw, keyframe.image)
