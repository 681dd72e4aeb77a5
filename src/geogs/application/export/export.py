"""A result in the formats of other programs: reads its folder, writes one export."""

from collections.abc import Callable, Sequence
from pathlib import Path

from geogs.application.export.image_sets import (
    write_colmap_set,
    write_map_set,
    write_nerfstudio_set,
)
from geogs.application.export.seen_points import cloud
from geogs.application.result_settings import ExportSettings, Format
from geogs.application.results.saved_result import SavedResult, load_result
from geogs.application.results.surfaces import fusion_views, splat_colours
from geogs.errors import InputError
from geogs.gpu.installation import require_device
from geogs.io.writers.exports.gsplat import write_gsplat_start
from geogs.io.writers.exports.las import write_las
from geogs.io.writers.exports.mesh_writers import write_glb, write_obj, write_textured_glb
from geogs.io.writers.ply_writer import write_points, write_splats
from geogs.io.writers.trajectories import write_euroc, write_kitti, write_tum_trajectory
from geogs.mesh.texture.textured import TexturedMesh, texture_mesh
from geogs.mesh.triangle_mesh import DepthMapView, Mesh, median_edge
from geogs.threads import on_one_torch_thread

Write = Callable[[SavedResult, ExportSettings, Path], Path]
"""Writes to a place, or to a file of its own name in it if that is a folder; what was written."""

TOLERANCE = 2.0
"""Median edges of the mesh that a face may lie off a depth map that shows it."""
_SUFFIXES = frozenset({".csv", ".glb", ".las", ".laz", ".npz", ".obj", ".ply", ".tum", ".txt"})
"""Endings of files; a folder is not named so."""


@on_one_torch_thread
def export(settings: ExportSettings) -> Path:
    """Write a result in another format; the folder or file.

    Raises:
        InputError: there is no result, it is too old, or lacks what the format needs.
        OutputError: a file cannot be written.
        DeviceError: the device cannot be used.
    """
    result = load_result(settings.result, require_device(settings.device))
    place = settings.output or result.folder / "export" / settings.to
    return _WRITERS[settings.to](result, settings, place)


def textured(result: SavedResult, mesh: Mesh, limit: int = 4096) -> TexturedMesh:
    """The mesh of a result with the images of its keyframes put together on it.

    ``limit`` is the longest side of the texture, pixels.

    Raises:
        InputError: the result has no keyframe images, or they show nothing of the mesh.
    """
    result.require_images()
    return texture_mesh(mesh, fusion_views(result.keyframes), TOLERANCE * median_edge(mesh), limit)


def _file(place: Path, name: str, *suffixes: str) -> Path:
    """The place if it is named like a file of that kind, else the usual name in it.

    Raises:
        InputError: it is named like a file of another kind.
    """
    suffixes = suffixes or (Path(name).suffix,)
    if place.suffix.lower() in _SUFFIXES - {*suffixes}:
        raise InputError(f"{place} should end in {' or '.join(suffixes)}, or be a folder.")
    return place if place.suffix.lower() in suffixes else place / name


def _colmap(result: SavedResult, settings: ExportSettings, place: Path) -> Path:
    write_colmap_set(place, result, settings.points, settings.text)
    return place


def _nerfstudio(result: SavedResult, settings: ExportSettings, place: Path) -> Path:
    write_nerfstudio_set(place, result, settings.points)
    return place


def _depth(result: SavedResult, settings: ExportSettings, place: Path) -> Path:
    write_map_set(place, result, "depth")
    return place


def _normals(result: SavedResult, settings: ExportSettings, place: Path) -> Path:
    write_map_set(place, result, "normals")
    return place


def _gsplat(result: SavedResult, settings: ExportSettings, place: Path) -> Path:
    path = _file(place, "start.npz")
    write_gsplat_start(path, result.disks, splat_colours(result.disks, _views(result)))
    return path


def _splats(result: SavedResult, settings: ExportSettings, place: Path) -> Path:
    colours = splat_colours(result.disks, _views(result))
    for name, is_flat in (("splats_3dgs.ply", False), ("splats_2dgs.ply", True)):
        write_splats(place / name, result.disks, colours, is_flat, settings.sh_degree)
    return place


def _cloud(result: SavedResult, settings: ExportSettings, place: Path) -> Path:
    path = _file(place, "cloud.ply", ".ply", ".las")
    positions, normals, colours = cloud(result.keyframes)
    if path.suffix.lower() == ".las":
        write_las(path, positions, colours)
    else:
        write_points(path, positions, colours, normals)
    return path


def _kitti(result: SavedResult, settings: ExportSettings, place: Path) -> Path:
    path = _file(place, "poses.txt")
    write_kitti(path, result.trajectory)
    return path


def _euroc(result: SavedResult, settings: ExportSettings, place: Path) -> Path:
    path = _file(place, "data.csv")
    write_euroc(path, result.trajectory)
    return path


def _tum(result: SavedResult, settings: ExportSettings, place: Path) -> Path:
    path = _file(place, "trajectory.txt", ".txt", ".tum")
    write_tum_trajectory(path, result.trajectory)
    return path


def _glb(result: SavedResult, settings: ExportSettings, place: Path) -> Path:
    mesh, path = _mesh(result), _file(place, "mesh.glb")
    if settings.textured:
        m = textured(result, mesh, settings.texture_size)
        write_textured_glb(path, m.vertices, m.faces, m.normals, m.uv, m.texture)
        return path
    write_glb(path, mesh.vertices, mesh.faces, mesh.normals, mesh.colours)
    return path


def _obj(result: SavedResult, settings: ExportSettings, place: Path) -> Path:
    mesh, path = _mesh(result), _file(place, "mesh.obj")
    write_obj(path, mesh.vertices, mesh.faces, mesh.normals, mesh.colours)
    return path


def _mesh(result: SavedResult) -> Mesh:
    if result.mesh is None:
        raise InputError(f"{result.folder} has no mesh.ply; geogs mesh {result.folder} makes it.")
    return result.mesh


def _views(result: SavedResult) -> Sequence[DepthMapView]:
    result.require_images()
    return fusion_views(result.keyframes)


_WRITERS: dict[Format, Write] = {
    "colmap": _colmap,
    "nerfstudio": _nerfstudio,
    "gsplat": _gsplat,
    "cloud": _cloud,
    "depth": _depth,
    "normals": _normals,
    "kitti": _kitti,
    "euroc": _euroc,
    "tum": _tum,
    "glb": _glb,
    "obj": _obj,
    "splats": _splats,
}
