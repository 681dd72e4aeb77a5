"""A result in the formats of other programs: reads its folder, writes one export."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from geogs.application.export.image_sets import (
    write_colmap_set,
    write_map_set,
    write_nerfstudio_set,
)
from geogs.application.export.seen_points import cloud
from geogs.application.result_settings import ExportSettings, Format
from geogs.application.results.output_folder import claimed
from geogs.application.results.saved_result import SavedResult, load_result
from geogs.application.results.surfaces import fusion_views, splat_colours
from geogs.errors import InputError
from geogs.gpu.installation import require_device
from geogs.io.writers.exports.gsplat import write_gsplat_start
from geogs.io.writers.exports.las import write_las
from geogs.io.writers.exports.mesh_writers import write_textured_glb
from geogs.io.writers.ply_writer import write_points, write_splats
from geogs.io.writers.replacement import replaced
from geogs.io.writers.trajectories import write_euroc, write_kitti, write_tum_trajectory
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
    "tum": ("trajectory.txt", ".txt", ".tum"),
}
"""Formats of a single file: its default name, and the allowed endings."""
_Y_DOWN = frozenset({"colmap", "kitti", "gsplat", "splats", "glb", "obj"})
"""Formats of worlds with y down, which viewers of COLMAP and of splats expect, and which the writers
of meshes turn to y up; others have z up."""
_SUFFIXES = frozenset({".csv", ".glb", ".las", ".laz", ".npz", ".obj", ".ply", ".tum", ".txt"})
"""Endings of files; a folder has none of these."""


@on_one_torch_thread
def export(settings: ExportSettings) -> Path:
    """Write a result in another format. Returns the folder or file.

    Raises:
        InputError: there is no result, it is too old, or lacks what the format needs.
        OutputError: a file cannot be written.
        DeviceError: the device cannot be used.
    """
    to = settings.to
    result = load_result(settings.result, require_device(settings.device))
    if not settings.as_tracked:
        stands = result.upright
        result = result.rotated(stands.y_down if to in _Y_DOWN else stands.axes)
    place = settings.output or result.folder / "export" / settings.to
    name, *suffixes = _FILES.get(to, (to,))
    if to == "glb" and settings.textured:  # beside the plain one
        name = "mesh_textured.glb"
    path = _file(place, name, *suffixes) if to in _FILES else place
    if path == settings.output and to in _FILES and to != "kitti":  # of two files
        _write(path, result, settings)
        return path
    # Existing content of the user's folder, or of the result's, is not trusted.
    folder = result.folder if settings.output is None else path if to not in _FILES else path.parent
    with claimed(folder) as output, replaced(output, "beside") as new:
        _write(new / path.relative_to(folder), result, settings)
    return path


def _write(path: Path, result: SavedResult, settings: ExportSettings) -> None:
    """Write an export to a file or into a folder."""
    match settings.to:
        case "colmap":
            write_colmap_set(path, result, settings.points, settings.text)
        case "nerfstudio":
            write_nerfstudio_set(path, result, settings.points)
        case "depth" | "normals":
            write_map_set(path, result, settings.to)
        case "gsplat":
            write_gsplat_start(path, result.disks, _disk_colours(result))
        case "splats":
            colours = _disk_colours(result)
            for name, is_flat in (("splats_3dgs.ply", False), ("splats_2dgs.ply", True)):
                write_splats(path / name, result.disks, colours, is_flat, settings.sh_degree)
        case "cloud":
            _write_cloud(path, result)
        case "kitti":
            write_kitti(path, result.trajectory.of("tracked"))
        case "euroc":
            write_euroc(path, result.trajectory.of("tracked"))
        case "tum":
            write_tum_trajectory(path, result.trajectory.of("tracked"))
        case "glb" | "obj":
            _write_mesh(path, result, settings)


def _file(place: Path, name: str, *suffixes: str) -> Path:
    """The path if it is named like a file of that format, else the default name in it.

    Raises:
        InputError: it is named like a file of another format.
    """
    if place.suffix.lower() in _SUFFIXES - {*suffixes}:
        raise InputError(f"{place} should end in {' or '.join(suffixes)}, or be a folder.")
    return place if place.suffix.lower() in suffixes else place / name


def _disk_colours(result: SavedResult) -> Float[np.ndarray, "n 3"]:
    """RGB in [0, 1] of the disks. Raises InputError if the result has no images."""
    result.require_images()
    return splat_colours(result.disks, fusion_views(result.renders))


def _write_cloud(path: Path, result: SavedResult) -> None:
    """Write the surface as points, by the ending of the path as LAS or PLY."""
    positions, normals, colours = cloud(result.renders)
    if path.suffix.lower() == ".las":
        write_las(path, positions, colours)
    else:
        write_points(path, positions, colours, normals)


def _write_mesh(path: Path, result: SavedResult, settings: ExportSettings) -> None:
    """Write the mesh of the result unchanged, or textured by the keyframes' images."""
    mesh = result.mesh
    if mesh is None:
        raise InputError(f"{result.folder} has no mesh.ply; geogs mesh {result.folder} makes it.")
    if settings.to == "obj" or not settings.textured:
        mesh.save(path)
    else:
        result.require_images()
        views = fusion_views(result.renders)
        # Largest distance of a face from a depth map that shows it, in median mesh edges.
        tolerance = 2.0 * median_edge(mesh)
        m = texture_mesh(mesh, views, tolerance, settings.texture_size)
        write_textured_glb(path, m.vertices, m.faces, m.normals, m.uv, m.texture)
