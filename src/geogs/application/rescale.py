"""A saved result brought to metres without another run."""

import json
import math
import shlex
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from geogs.application.checkpoints.checkpoint import has_checkpoint
from geogs.application.export.export import export, exports_of
from geogs.application.reconstruct import ReconstructState
from geogs.application.result_settings import RescaleSettings
from geogs.application.results.output_folder import claimed
from geogs.application.results.result_page import write_page_anew
from geogs.application.results.saved_result import SavedResult, load_result, result_folder
from geogs.application.scale.known_length import (
    HOW,
    KnownLength,
    SensorScale,
    find_scale,
    scale_source,
)
from geogs.application.scale.measurable_scene import SeenKeyframe, measurable
from geogs.errors import InputError
from geogs.evaluation.true_scene import scaled
from geogs.gpu.installation import require_device
from geogs.guard.atomic import write_text
from geogs.guard.documents import UNUSABLE
from geogs.guard.replacement import replaced
from geogs.io.ply_reader import read_ply
from geogs.io.pose_files import read_tum_trajectory
from geogs.io.sources.calibration_files import read_calibration
from geogs.io.writers.map_file import MapViews, load_map_file, save_map, save_map_with_views
from geogs.io.writers.ply_writer import SH_DEGREE_0, write_splats
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.io.writers.uncertainty import HEADER, moved_rows
from geogs.mesh.mesh_file import read_mesh
from geogs.mesh.triangle_mesh import Mesh
from geogs.on_demand import OnDemand
from geogs.threads import on_one_torch_thread
from geogs.types import MapSnapshot, MetricScale

_STAGES = ("", "online/", "adjusted/")
_EVALUATION = frozenset(
    {"eval.json", *(f"report/{name}.png" for name in
     ("trajectory_truth", "trajectory_error", "reliability", "mesh_truth"))}
)  # fmt: skip
"""Files of an evaluation, which holds for the unit in which it was made."""


@on_one_torch_thread
def rescale(settings: RescaleSettings) -> MetricScale:
    """Find metres per map unit, and write trajectories, map, meshes, summary and page in metres.

    All replace the previous ones together; an evaluation is deleted. Then the exports that lie in
    the folder are made anew, with their options.

    Raises:
        InputError: there is no result, no length is given, the scale cannot be determined, or the
            result is that of a run that a checkpoint would finish in the old unit.
        OutputError: a file cannot be written.
        DeviceError: the device cannot be used.
    """
    source = scale_source(settings.scale_from)
    if source is None or isinstance(source, SensorScale):
        raise InputError(f"Nothing is known of the scale; {HOW.replace(' or sensor', '')}.")
    folder = result_folder(settings.result)
    if has_checkpoint(folder):
        raise InputError(f"{folder} holds an unfinished {_way_on(folder, settings.scale_from)}")
    exports = exports_of(folder, settings.device)
    with claimed(folder), replaced(folder, "part", _EVALUATION) as new:
        result = load_result(folder, require_device(settings.device))
        factor_before = _factor(result)
        found = _found(result, source)
        summary = {
            **result.summary,
            "scale": f"metric ({found.origin})",
            "metric_scale": asdict(replace(found, factor=factor_before * found.factor)),
        }
        _scale_files(new, result, found.factor, summary)
    for exported in exports:
        export(exported.scaled(found.factor))
    return found


def _way_on(folder: Path, scale_from: str) -> str:
    """The command that finishes the work of a folder, of which a run makes metres by itself."""
    if has_checkpoint(folder, ReconstructState):
        words = shlex.join(["--resume", str(folder)])
        return (
            f"reconstruction; finish it first: geogs reconstruct {words}, with its source and "
            "settings."
        )
    words = shlex.join(["--resume", str(folder), "--scale-from", scale_from])
    return f"run; geogs run {words} finishes it in metres."


def _factor(result: SavedResult) -> float:
    """Earlier factor on lengths. Raises InputError if the summary does not hold it."""
    before = result.summary.get("metric_scale")
    try:
        factor = 1.0 if before is None else float(before["factor"])
    except UNUSABLE:
        factor = 0.0
    if not 0 < factor < math.inf:
        path = result.folder / "summary.json"
        raise InputError(f"{path} does not say by which factor it is metric; was it changed?")
    return factor


def _found(result: SavedResult, source: KnownLength) -> MetricScale:
    camera = result.camera
    views = result.views
    calibration = read_calibration(result.folder / "intrinsics.json")
    if calibration.width is None:
        calibration = replace(calibration, width=camera.width, height=camera.height)

    def seen(number: int) -> SeenKeyframe:
        return SeenKeyframe(views.T_cw[number], result.image(number))

    keyframes = OnDemand(range(len(views.keyframe_id)), seen)
    scene = measurable(camera, result.renderer, keyframes, result.trajectory)
    return find_scale(scene, source, calibration)


def _scale_files(new: Path, result: SavedResult, factor: float, summary: dict[str, Any]) -> None:
    """Write all files of a result that hold lengths, scaled."""
    folder = result.folder
    disks = result.disks
    world = disks.scaled(factor)
    colours = _splat_colours(folder / "splats.ply", len(disks))
    moved = _scale_map(new, result, world, factor)
    for stage in _STAGES:
        for name in ("trajectory.tum", "keyframes.tum"):
            path = folder / stage / name
            if path.is_file():
                write_tum_trajectory(new / stage / name, scaled(read_tum_trajectory(path), factor))
    meshes = [
        _scale_mesh(folder, new, f"{stage}mesh.ply", factor)
        for stage in (*_STAGES, "depth_fusion/")
    ]
    for kept in sorted(folder.glob("snapshots/*/map.safetensors")):
        place = kept.parent.relative_to(folder)
        snapshot = load_map_file(kept)
        save_map(new / place / kept.name, snapshot.disks.scaled(factor), snapshot.metadata)
        _scale_mesh(folder, new, f"{place}/mesh.ply", factor)
    table = "trajectory_uncertainty.csv"
    if (folder / table).is_file():
        write_text(new / table, "\n".join([HEADER, *moved_rows(folder / table, factor), ""]))
    if colours is not None:
        write_splats(new / "splats.ply", world, colours)
    write_text(new / "summary.json", json.dumps(summary, indent=2))
    trajectory = scaled(result.trajectory, factor)
    write_page_anew(new, replace(result, disks=world, views=moved), meshes[0], trajectory, summary)


def _scale_map(new: Path, result: SavedResult, world: MapSnapshot, factor: float) -> MapViews:
    """Write ``map.safetensors`` with the disks in metres."""
    views = result.views
    metadata = load_map_file(result.folder / "map.safetensors").metadata
    said = {k: v for k, v in metadata.items() if k != "views"}
    T_cw = views.T_cw.copy()
    T_cw[:, :3, 3] *= factor
    # A map in the world's own frame stays in it; another keeps its own unit, for precision.
    own = views.disks if views.origin.any() or views.unit != 1.0 else None
    moved = replace(
        views,
        origin=factor * views.origin,
        unit=1.0 if own is None else factor * views.unit,
        disks=world if own is None else own,
        T_cw=T_cw,
    )
    save_map_with_views(new / "map.safetensors", moved, said)
    return moved


def _splat_colours(path: Path, count: int) -> np.ndarray | None:
    """The colours of the splats; none where there are none. Raises InputError if their number is
    not that of the disks, before anything has been changed."""
    if not path.is_file():
        return None
    columns = read_ply(path)["vertex"].columns
    colours: np.ndarray = np.stack([columns[f"f_dc_{k}"] for k in range(3)], 1) * SH_DEGREE_0 + 0.5
    if len(colours) != count:
        raise InputError(f"{path} has not as many disks as the map; was it changed?")
    return colours


def _scale_mesh(folder: Path, new: Path, name: str, factor: float) -> Mesh | None:
    if not (folder / name).is_file():
        return None
    mesh = read_mesh(folder / name)
    mesh = replace(mesh, vertices=factor * mesh.vertices)
    mesh.save(new / name)
    return mesh
