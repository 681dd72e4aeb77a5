"""A result in metres by what is known of it afterwards, without running again."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from geogs.application.result_settings import RescaleSettings
from geogs.application.results.result_page import write_page_anew
from geogs.application.results.saved_result import SavedResult, load_result
from geogs.application.scale.known_length import HOW, SensorScale, find_scale, scale_source
from geogs.application.scale.measurable_scene import SeenKeyframe, measurable
from geogs.errors import InputError
from geogs.evaluation.true_scene import scaled
from geogs.gpu.installation import require_device
from geogs.io.ply_reader import read_ply
from geogs.io.pose_files import read_tum_trajectory
from geogs.io.sources.calibration_files import read_calibration
from geogs.io.writers.atomic import write_text
from geogs.io.writers.map_file import load_map_file, save_map_with_views
from geogs.io.writers.ply_writer import SH_DEGREE_0, write_mesh, write_splats
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.io.writers.uncertainty import HEADER, moved_rows
from geogs.mesh.mesh_file import read_mesh
from geogs.on_demand import OnDemand
from geogs.threads import on_one_torch_thread
from geogs.types import MapSnapshot, MetricScale

_STAGES = ("", "online/", "adjusted/")


@on_one_torch_thread
def rescale(settings: RescaleSettings) -> MetricScale:
    """Find metres to the map unit, and write trajectories, map, meshes and summary in metres.

    The summary goes first and comes last, so that no half of a result has one. Exports that were
    made before stay what they are.

    Raises:
        InputError: there is no result, nothing is known, or the result does not tell its scale.
        OutputError: a file cannot be written.
        DeviceError: the device cannot be used.
    """
    source = scale_source(settings.scale_from)
    if source is None or isinstance(source, SensorScale):
        raise InputError(f"Nothing is known of the scale; {HOW.replace(' or sensor', '')}.")
    folder = settings.result
    result = load_result(folder, require_device(settings.device))
    summary, calibration = dict(result.summary), read_calibration(folder / "intrinsics.json")
    camera = result.camera
    if calibration.width is None:
        calibration = replace(calibration, width=camera.width, height=camera.height)
    views = result.views

    def seen(number: int) -> SeenKeyframe:
        return SeenKeyframe(views.T_cw[number], result.image(number))

    keyframes = OnDemand(range(len(views.keyframe_id)), seen)
    scene = measurable(camera, result.renderer, keyframes, result.trajectory)
    found = find_scale(scene, source, calibration)
    (folder / "summary.json").unlink()
    _scale_files(result, found.factor)
    write_text(folder / "summary.json", json.dumps(_scaled_summary(summary, found), indent=2))
    write_page_anew(folder)
    return found


def _scale_files(result: SavedResult, factor: float) -> None:
    """All files of a result that hold lengths, multiplied."""
    folder, disks = result.folder, result.disks
    world = replace(disks, position=factor * disks.position, scale=factor * disks.scale)
    colours = _splat_colours(folder / "splats.ply", len(disks))
    _scale_map(result, world, factor)
    for stage in _STAGES:
        for name in ("trajectory.tum", "keyframes.tum"):
            _scale_poses(folder / f"{stage}{name}", factor)
        _scale_mesh(folder / f"{stage}mesh.ply", factor)
    _scale_mesh(folder / "depth_fusion" / "mesh.ply", factor)
    _scale_table(folder / "trajectory_uncertainty.csv", factor)
    if colours is not None:
        write_splats(folder / "splats.ply", world, colours)


def _scale_map(result: SavedResult, world: MapSnapshot, factor: float) -> None:
    """``map.safetensors`` with the disks as they are in metres."""
    path, views = result.folder / "map.safetensors", result.views
    said = {k: v for k, v in load_map_file(path).metadata.items() if k != "views"}
    T_cw = views.T_cw.copy()
    T_cw[:, :3, 3] *= factor
    # A map in the world's own frame stays in it; another keeps its digits in its own unit.
    own = views.disks if views.origin.any() or views.unit != 1.0 else None
    moved = replace(
        views,
        origin=factor * views.origin,
        unit=1.0 if own is None else factor * views.unit,
        disks=world if own is None else own,
        T_cw=T_cw,
    )
    save_map_with_views(path, world, moved, said)


def _splat_colours(path: Path, count: int) -> np.ndarray | None:
    """The colours of the splats; none where there are none. Raises InputError if they are not as
    many as the disks, before anything has been changed."""
    if not path.is_file():
        return None
    columns = read_ply(path)["vertex"].columns
    colours: np.ndarray = np.stack([columns[f"f_dc_{k}"] for k in range(3)], 1) * SH_DEGREE_0 + 0.5
    if len(colours) != count:
        raise InputError(f"{path} has not as many disks as the map; was it changed?")
    return colours


def _scale_poses(path: Path, factor: float) -> None:
    if path.is_file():
        write_tum_trajectory(path, scaled(read_tum_trajectory(path), factor))


def _scale_mesh(path: Path, factor: float) -> None:
    if path.is_file():
        mesh = read_mesh(path)
        write_mesh(path, factor * mesh.vertices, mesh.faces, mesh.colours, mesh.normals)


def _scale_table(path: Path, factor: float) -> None:
    if path.is_file():
        write_text(path, "\n".join([HEADER, *moved_rows(path, factor), ""]))


def _scaled_summary(summary: dict[str, Any], found: MetricScale) -> dict[str, Any]:
    """The summary with the scale; what had multiplied lengths before is multiplied in."""
    before = summary.get("metric_scale")
    factor = float(before["factor"]) if isinstance(before, dict) else 1.0
    metric = asdict(replace(found, factor=factor * found.factor))
    return {**summary, "scale": f"metric ({found.origin})", "metric_scale": metric}
