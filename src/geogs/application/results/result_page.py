"""``report/``: the page of a result, with an interactive model; needs no ground truth."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from geogs.application.results.saved_result import SavedResult
from geogs.application.results.upright import tracked_poses, upright
from geogs.evaluation.model_view.levelling import facets
from geogs.evaluation.model_view.room import find_room
from geogs.evaluation.model_view.shown_model import (
    Colouring,
    DiskModel,
    ImageExtent,
    KeyframeModel,
    Lengths,
    PathModel,
    ShownModel,
    SurfaceModel,
)
from geogs.evaluation.model_view.start_view import start_view
from geogs.evaluation.pages.run_page import lengths, write_run_page
from geogs.geometry.camera import Camera
from geogs.mesh.triangle_mesh import Mesh
from geogs.threads import ordered_map, worker_count
from geogs.types import MapSnapshot, RenderedKeyframe, Trajectory

MAX_DISKS, MAX_IMAGES = 50_000, 240
"""Largest numbers of each on a page, which then has less than 8 MB."""
IMAGE_BYTES = 1_500_000
"""Approximate size of all images of a page together in bytes."""
_BYTES_A_PIXEL = 0.2
_MAX_EDGE, _MIN_EDGE = 480, 128
_QUALITY = 75


@dataclass(frozen=True)
class ShownView:
    """A keyframe of the page; its image is read on demand."""

    timestamp: float
    T_wc: Float[np.ndarray, "4 4"]
    image: Callable[[], UInt8[np.ndarray, "h w 3"] | None]


def write_pictures(
    folder: Path, renders: Sequence[RenderedKeyframe], unit: str = "map units"
) -> None:
    """Draw ``keyframes.png``: renders beside images, of up to five keyframes.

    Raises:
        OutputError: the file cannot be written.
    """
    from geogs.evaluation.pages import run_pictures

    if not len(renders):
        return
    numbers = np.linspace(0, len(renders) - 1, min(5, len(renders))).round().astype(int)
    shown = [renders[i] for i in numbers]
    run_pictures.draw_keyframes(
        folder / "keyframes.png",
        [run_pictures.layer_picture(r, "image") for r in shown],
        [r.depth.cpu().numpy() for r in shown],
        [r.normal.cpu().numpy() for r in shown],
        unit,
    )


def write_page(
    folder: Path,
    trajectory: Trajectory,
    renders: Sequence[RenderedKeyframe],
    mesh: Mesh | None,
    summary: Mapping[str, object],
    disks: MapSnapshot | None = None,
) -> None:
    """Write the page of a result into the folder of its picture of keyframes.

    Raises:
        OutputError: a file cannot be written.
    """
    model = None
    if renders:
        views = _rendered_views(renders)
        camera = renders[0].camera
        model = shown_model(
            trajectory, views, camera, mesh, disks, lengths(summary), renders=renders
        )
    _write_with_path(folder, trajectory, mesh, summary, model)


def write_page_anew(
    new: Path,
    result: SavedResult,
    mesh: Mesh | None,
    trajectory: Trajectory | None = None,
    summary: Mapping[str, Any] | None = None,
) -> None:
    """Write the page of a result and its pictures again for a new mesh, if it has a page.

    ``new`` is the folder of its new files. Trajectory and summary default to those of the result.

    Raises:
        InputError: the result is damaged.
        OutputError: it cannot be written.
    """
    if not (result.folder / "summary.json").is_file() or not (result.folder / "report").is_dir():
        return
    trajectory = result.trajectory if trajectory is None else trajectory
    summary = result.summary if summary is None else summary
    faces = 0 if mesh is None else len(mesh.faces)
    views = shown_views(result)
    model = shown_model(
        trajectory,
        views,
        result.camera,
        mesh,
        result.disks,
        lengths(summary),
        renders=result.renders,
    )
    write_pictures(new / "report", result.renders, lengths(summary).name)
    _write_with_path(new / "report", trajectory, mesh, {**summary, "mesh_faces": faces}, model)


def _write_with_path(
    folder: Path,
    trajectory: Trajectory,
    mesh: Mesh | None,
    summary: Mapping[str, Any],
    model: ShownModel | None,
) -> None:
    """Draw the path, upright, and write the page with that and the picture of keyframes."""
    from geogs.evaluation.pages.run_pictures import draw_path

    up = upright(trajectory, mesh).axes if model is None else model.axes
    draw_path(folder / "trajectory.png", trajectory, up, lengths(summary).name)
    write_run_page(folder, summary, model)


def result_lengths(result: SavedResult) -> Lengths:
    """Unit of length of a saved result; unknown where it has no summary."""
    has_summary = (result.folder / "summary.json").is_file()
    return lengths(result.summary) if has_summary else Lengths()


def shown_views(result: SavedResult) -> list[ShownView]:
    """The keyframes of a saved result; images are read on demand."""
    views = result.views
    return [
        ShownView(float(time), np.linalg.inv(T_cw), partial(result.image, number))
        for number, (time, T_cw) in enumerate(zip(views.timestamp, views.T_cw, strict=True))
    ]


def _rendered_views(renders: Sequence[RenderedKeyframe]) -> list[ShownView]:
    """The keyframes of the page; images are read on demand."""

    def image(number: int) -> UInt8[np.ndarray, "h w 3"] | None:
        return renders[number].image

    def view(number: int) -> ShownView:
        render = renders[number]
        T_wc = np.linalg.inv(render.T_cw.cpu().numpy())
        return ShownView(render.timestamp, T_wc, partial(image, number))

    return list(ordered_map(view, range(len(renders)), worker_count()))


def shown_model(
    trajectory: Trajectory,
    views: Sequence[ShownView],
    camera: Camera,
    mesh: Mesh | None,
    disks: MapSnapshot | None,
    unit: Lengths,
    more_colourings: Callable[[Mesh], Sequence[Colouring]] = lambda mesh: (),
    true_path: Float[np.ndarray, "n 3"] | None = None,
    renders: Sequence[RenderedKeyframe] = (),
) -> ShownModel:
    """The model for the page of a result.

    Args:
        trajectory: poses of all frames.
        views: the keyframes.
        camera: camera of their images.
        mesh: the surface, if there is one.
        disks: the map, if its disks are shown.
        unit: unit of length of the map.
        more_colourings: further colourings of the shown surface, besides the images' colours.
        true_path: positions of the true camera, in the frame of the map.
        renders: the keyframes with depth, from whose images the surface gets a texture.
    """
    notes = []
    surface = None
    seen = None
    disk_model = None
    if mesh is not None and len(mesh.faces):
        from geogs.application.results.page_surface import page_surface

        shown, texture = page_surface(mesh, renders)
        colourings = more_colourings(shown)
        if texture is None and shown.colours is not None:
            colourings = [Colouring("Colour", shown.colours), *colourings]
        surface = SurfaceModel(shown.vertices, shown.faces, shown.normals, colourings, texture)
        if len(surface.faces) < len(mesh.faces):
            notes.append(f"Shown with {len(surface.faces):,} of {len(mesh.faces):,} triangles.")
        seen = facets(surface.vertices, surface.faces, surface.normals)
    if disks is not None and len(disks):
        disk_model = _disks(disks)
        if len(disk_model.position) < len(disks):
            notes.append(f"The {MAX_DISKS:,} largest of {len(disks):,} disks are shown.")
    paths = [PathModel("Path", trajectory.T_wc[:, :3, 3], trajectory.states)]
    if true_path is not None:
        paths.append(PathModel("True path", true_path))
    shape = None if surface is None else surface.vertices
    shape = shape if shape is not None or disk_model is None else disk_model.position
    T_wc = tracked_poses(trajectory)
    levelled = upright(trajectory, mesh)
    start = start_view(T_wc[:, :3, 3] if shape is None else shape, levelled.axes, T_wc, seen)
    return ShownModel(
        levelled.axes,
        start,
        ImageExtent(camera.width / 2 / camera.fx, camera.height / 2 / camera.fy),
        surface,
        paths,
        _keyframes(views, camera),
        disk_model,
        None if seen is None else find_room(seen, levelled.axes, T_wc),
        unit,
        [unit.note, *notes],
    )


def _disks(disks: MapSnapshot) -> DiskModel:
    position, quaternion, scale = (
        part.cpu().numpy() for part in (disks.position, disks.quaternion, disks.scale)
    )
    kept = np.arange(len(position))
    if len(kept) > MAX_DISKS:
        kept = np.sort(np.argsort(-scale.prod(1), kind="stable")[:MAX_DISKS])
    return DiskModel(position[kept], quaternion[kept], scale[kept])


def _keyframes(views: Sequence[ShownView], camera: Camera) -> list[KeyframeModel]:
    """All keyframes; only some have images if there are many, and more images are smaller."""
    count = min(len(views), MAX_IMAGES)
    with_image = set(np.linspace(0, len(views) - 1, count).round().astype(int).tolist())
    pixels = IMAGE_BYTES / max(count, 1) / _BYTES_A_PIXEL
    edge = int(
        (pixels * max(camera.width, camera.height) / min(camera.width, camera.height)) ** 0.5
    )
    edge = min(max(edge, _MIN_EDGE), _MAX_EDGE)
    start = views[0].timestamp if views else 0.0

    def shown(number: int) -> KeyframeModel:
        view = views[number]
        image = view.image() if number in with_image else None
        name = f"keyframe {number + 1} of {len(views)}, {view.timestamp - start:.1f} s"
        return KeyframeModel(name, view.T_wc, None if image is None else _jpeg(image, edge))

    return list(ordered_map(shown, range(len(views)), worker_count()))


def _jpeg(image: UInt8[np.ndarray, "h w 3"], edge: int) -> bytes:
    import cv2

    height, width = image.shape[:2]
    shrink = min(1.0, edge / max(height, width))
    size = (max(round(width * shrink), 1), max(round(height * shrink), 1))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, stream = cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return stream.tobytes()
