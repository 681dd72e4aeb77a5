"""A result in the formats of other programs: reads its folder, writes one export."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from geogs.application.export.image_sets import (
    write_colmap_set,
    write_map_set,
    write_nerfstudio_set,
)
from geogs.application.export.part import Part
from geogs.application.export.plan import draw_cut
from geogs.application.export.region import read_region
from geogs.application.export.seen_points import cloud
from geogs.application.result_settings import ExportSettings, Format
from geogs.application.results.output_folder import claimed
from geogs.application.results.result_page import result_lengths
from geogs.application.results.saved_result import load_result
from geogs.application.results.surfaces import fusion_views, splat_colours
from geogs.application.results.upright import tracked_poses
from geogs.errors import InputError
from geogs.gpu.installation import require_device
from geogs.guard.atomic import write_text
from geogs.guard.documents import read_json
from geogs.guard.replacement import replaced
from geogs.io.writers.exports.gsplat import write_gsplat_start
from geogs.io.writers.exports.las import write_las
from geogs.io.writers.exports.line_drawing import write_drawing
from geogs.io.writers.exports.mesh_writers import write_textured_glb
from geogs.io.writers.exports.usdz_writer import write_usdz
from geogs.io.writers.ply_writer import write_points, write_splats
from geogs.io.writers.trajectories import write_euroc, write_kitti, write_tum_trajectory
from geogs.mesh.decimation.decimate import with_at_most
from geogs.mesh.texture.textured import texture_mesh
from geogs.mesh.triangle_mesh import median_edge
from geogs.threads import on_one_torch_thread

_FILES: dict[Format, tuple[str, ...]] = {
    "cloud": ("cloud.ply", ".ply", ".las"),
    "euroc": ("data.csv", ".csv"),
    "glb": ("mesh.glb", ".glb"),
    "gsplat": ("start.npz", ".npz"),
    "kitti": ("poses.txt", ".txt"),
    "obj": ("mesh.obj", ".obj"),
    "plan": ("plan.svg", ".svg", ".pdf", ".dxf"),
    "section": ("section.svg", ".svg", ".pdf", ".dxf"),
    "stl": ("mesh.stl", ".stl"),
    "tum": ("trajectory.txt", ".txt", ".tum"),
    "usdz": ("mesh.usdz", ".usdz"),
}
"""Formats of a single file: its default name, and the allowed endings."""
_Y_DOWN = frozenset({"colmap", "kitti", "gsplat", "splats", "glb", "obj", "stl", "usdz"})
"""Formats of worlds with y down, which viewers of COLMAP and of splats expect, and which writers of
meshes turn to y or z up; others have z up."""
_NOT_CROPPED = frozenset({"colmap", "nerfstudio", "depth", "normals", "kitti", "euroc", "tum"})
"""Formats of images and of the camera's path, of which no part is cut out."""
_SUFFIXES = frozenset(
    {suffix for _, *suffixes in _FILES.values() for suffix in suffixes} | {".laz"}
)
"""Endings of files; a folder has none of these."""
EXPORTS = "export/exports.json"
"""List of the exports in the folder of a result."""
_OPTIONS = tuple(
    f.name for f in fields(ExportSettings) if f.name not in ("result", "output", "device")
)
"""Settings of an export that are kept."""
MOST_ON_PHONES = 200_000
"""Most triangles of a USDZ, which phones show without delay."""


@on_one_torch_thread
def export(settings: ExportSettings) -> Path:
    """Write a result in another format. Returns the folder or file.

    Raises:
        InputError: there is no result, it is too old, or lacks what the format needs.
        OutputError: a file cannot be written.
        DeviceError: the device cannot be used.
    """
    to = settings.to
    region = read_region(settings.crop)
    if region is not None and to in _NOT_CROPPED:
        raise InputError(f"--crop cuts surfaces, drawings and splats, not {to}; leave it out.")
    result = load_result(settings.result, require_device(settings.device))
    axes = np.eye(3)
    if not settings.as_tracked:
        axes = result.upright.axes
        R = result.upright.y_down if to in _Y_DOWN else axes
        result = result.rotated(R)
        axes = axes @ R.T
    if settings.images and to not in ("colmap", "nerfstudio"):
        raise InputError(f"--images is for colmap and nerfstudio, not {to}; leave it out.")
    part = Part(result, region, axes, settings.images)
    place = settings.output or result.folder / "export" / settings.to
    name, *suffixes = _FILES.get(to, (to,))
    if to == "glb" and settings.textured and result.views.has_images:  # beside the plain one
        name = "mesh_textured.glb"
    path = _file(place, name, *suffixes) if to in _FILES else place
    if path == settings.output and to in _FILES and to != "kitti":  # of two files
        _write(path, part, settings)
        return path
    # Existing content of the user's folder, or of the result's, is not trusted.
    folder = result.folder if settings.output is None else path if to not in _FILES else path.parent
    with claimed(folder) as output, replaced(output, "beside") as new:
        _write(new / path.relative_to(folder), part, settings)
        if settings.output is None:
            _record(new, folder, path, settings)
    return path


def _record(new: Path, folder: Path, path: Path, settings: ExportSettings) -> None:
    """Add an export in the folder of a result to the list of these, with its options."""
    options = {name: getattr(settings, name) for name in _OPTIONS}
    listed = {**_recorded(folder), str(path.relative_to(folder)): options}
    write_text(new / EXPORTS, json.dumps(listed, indent=1, sort_keys=True) + "\n")


def _recorded(folder: Path) -> dict[str, dict[str, Any]]:
    """The exports in the folder of a result: options by their paths."""
    if not (folder / EXPORTS).is_file():
        return {}
    listed = read_json(folder / EXPORTS)
    if not isinstance(listed, dict) or not all(isinstance(v, dict) for v in listed.values()):
        raise InputError(f"{folder / EXPORTS} is damaged; delete it, and export anew.")
    return listed


def exports_of(folder: Path, device: str) -> list[ExportSettings]:
    """Settings by which the exports that lie in the folder of a result are made anew.

    Raises:
        InputError: the list of them is damaged, or one has the images of what the run read, which a
            list may not name.
    """
    found = []
    for path, options in _recorded(folder).items():
        if not (folder / path).exists():
            continue
        if options.get("images"):
            raise InputError(
                f"{folder / path} was made with --images; delete it, and export it anew afterwards."
            )
        known = {k: v for k, v in options.items() if k in _OPTIONS and k != "images"}
        try:
            found.append(ExportSettings(folder, **known, device=device))
        except (TypeError, InputError):
            raise InputError(
                f"{folder / EXPORTS} is damaged; delete it, and export anew."
            ) from None
    return found


def _write(path: Path, part: Part, settings: ExportSettings) -> None:
    """Write an export to a file or into a folder."""
    result = part.result
    match settings.to:
        case "colmap":
            write_colmap_set(path, result, settings.points, settings.text, part.originals)
        case "nerfstudio":
            write_nerfstudio_set(path, result, settings.points, part.originals)
        case "depth" | "normals":
            write_map_set(path, result, settings.to)
        case "gsplat":
            write_gsplat_start(path, part.disks, _disk_colours(part))
        case "splats":
            colours = _disk_colours(part)
            for name, is_flat in (("splats_3dgs.ply", False), ("splats_2dgs.ply", True)):
                write_splats(path / name, part.disks, colours, is_flat, settings.sh_degree)
        case "cloud":
            _write_cloud(path, part)
        case "kitti":
            write_kitti(path, result.trajectory.of("tracked"))
        case "euroc":
            write_euroc(path, result.trajectory.of("tracked"))
        case "tum":
            write_tum_trajectory(path, result.trajectory.of("tracked"))
        case "plan" | "section":
            cameras = tracked_poses(result.trajectory)[:, :3, 3]
            drawing = draw_cut(
                part.mesh, settings.to, settings.cut, result_lengths(result), cameras
            )
            for suffix in (path.suffix,) if path == settings.output else _FILES[settings.to][1:]:
                write_drawing(path.with_suffix(suffix), drawing)
        case "glb" | "obj" | "stl" | "usdz":
            _write_mesh(path, part, settings)


def _file(place: Path, name: str, *suffixes: str) -> Path:
    """The path if it is named like a file of that format, else the default name in it.

    Raises:
        InputError: it is named like a file of another format.
    """
    if place.suffix.lower() in _SUFFIXES - {*suffixes}:
        raise InputError(f"{place} should end in {' or '.join(suffixes)}, or be a folder.")
    return place if place.suffix.lower() in suffixes else place / name


def _disk_colours(part: Part) -> Float[np.ndarray, "n 3"]:
    """RGB in [0, 1] of the disks. Raises InputError if the result has no images."""
    part.result.require_images()
    return splat_colours(part.disks, fusion_views(part.result.renders))


def _write_cloud(path: Path, part: Part) -> None:
    """Write the surface as points, by the ending of the path as LAS or PLY."""
    positions, normals, colours = cloud(part.result.renders)
    kept = part.holds(positions)
    if path.suffix.lower() == ".las":
        write_las(path, positions[kept], colours[kept])
    else:
        write_points(path, positions[kept], colours[kept], normals[kept])


def _write_mesh(path: Path, part: Part, settings: ExportSettings) -> None:
    """Write the mesh of the result, where asked textured by the keyframes' images."""
    mesh = part.mesh
    to = settings.to
    if to == "usdz" and len(mesh.faces) > MOST_ON_PHONES:
        mesh = with_at_most(mesh, MOST_ON_PHONES)
    if to in ("obj", "stl") or not (settings.textured and part.result.views.has_images):
        mesh.save(path)
        return
    views = fusion_views(part.result.renders)
    # Largest distance of a face from a depth map that shows it, in median mesh edges.
    tolerance = 2.0 * median_edge(mesh)
    m = texture_mesh(mesh, views, tolerance, settings.texture_size)
    if to == "glb":
        write_textured_glb(path, m.vertices, m.faces, m.normals, m.uv, m.texture)
    else:
        metres = result_lengths(part.result).metres or 1.0
        write_usdz(path, m.vertices, m.faces, m.normals, (m.uv, m.texture), metres)
