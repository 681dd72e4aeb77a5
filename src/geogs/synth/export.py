"""Writes a synthetic sequence with its ground truth in the layout of Replica."""

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from geogs.errors import InputError, OutputError
from geogs.geometry.camera import Camera
from geogs.io.writers.atomic import atomic_file, prepare_output_folder, write_text
from geogs.io.writers.ply import write_mesh, write_points
from geogs.synth.raycast import Raycaster, View
from geogs.synth.room import make_room
from geogs.synth.tessellation import SeenSurface, scene_mesh
from geogs.synth.trajectory import handheld_trajectory

DEPTH_SCALE = 6553.5
"""Units of the depth PNGs per metre, as in Replica."""

_MAX_SIZE = 8192


def default_camera(width: int, height: int) -> Camera:
    """A camera of 71 degrees across with its principal point in the middle of the image."""
    if not (16 <= width <= _MAX_SIZE and 16 <= height <= _MAX_SIZE):
        raise InputError(f"images must be 16 to {_MAX_SIZE} pixels a side, not {width}x{height}")
    f = 0.7 * width
    return Camera(f, f, (width - 1) / 2, (height - 1) / 2, width, height)


def write_sequence(
    folder: Path | str,
    frames: int = 120,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    *,
    depth: bool = True,
    image_format: str = "jpg",
    video: bool = False,
    threads: int = 2,
    on_frame: Callable[[int], None] = lambda index: None,
) -> None:
    """Renders a room and writes images, depths, poses, intrinsics and the true surface.

    ``results/frame%06d.jpg`` (or png), ``results/depth%06d.png`` (z, 6553.5 to the metre),
    ``traj.txt`` (camera to world, one row-major 4x4 a line), ``cam_params.json``, ``mesh.ply`` (the
    whole room), ``points_seen_1cm.ply`` (what the camera saw), and ``video.mp4`` if asked for.
    ``on_frame`` is called after each frame. Raises OutputError if the folder cannot be written.
    """
    if image_format not in ("jpg", "png"):
        raise InputError(f"images can be written as jpg or png, not {image_format}")
    camera = default_camera(width, height)
    scene = make_room(seed)
    trajectory = handheld_trajectory(scene, frames, seed)
    folder = prepare_output_folder(folder)
    results = prepare_output_folder(folder / "results")
    _write_camera(folder / "cam_params.json", camera, seed)
    with atomic_file(folder / "traj.txt") as stream:
        np.savetxt(stream, trajectory.reshape(-1, 16), fmt="%.9f")
    write_mesh(folder / "mesh.ply", *scene_mesh(scene))
    raycaster = Raycaster(scene, threads)

    def render(index: int) -> View:
        view = raycaster.render(camera, trajectory[index])
        _write_view(results, index, view, image_format, depth)
        return view

    seen = SeenSurface(scene, camera)
    with ThreadPoolExecutor(threads) as pool:
        views = pool.map(render, range(frames))
        if video:
            views = _encode(folder / "video.mp4", camera, views)
        for index, view in enumerate(views):
            seen.add(view.depth, trajectory[index])
            on_frame(index)
    write_points(folder / "points_seen_1cm.ply", seen.points)


def _write_view(results: Path, index: int, view: View, image_format: str, depth: bool) -> None:
    quality = [cv2.IMWRITE_JPEG_QUALITY, 95] if image_format == "jpg" else []
    name = results / f"frame{index:06d}.{image_format}"
    _write_image(name, cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR), quality)
    if depth:
        units = np.rint(view.depth * DEPTH_SCALE).clip(0, 65535).astype(np.uint16)
        # Level 1 is four times faster than the default and a few percent larger.
        name = results / f"depth{index:06d}.png"
        _write_image(name, units, [cv2.IMWRITE_PNG_COMPRESSION, 1])


def _write_image(path: Path, image: np.ndarray, options: list[int]) -> None:
    try:
        path.write_bytes(cv2.imencode(path.suffix, image, options)[1].tobytes())
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError(f"{path} cannot be written ({reason}); free some space.") from error


def _write_camera(path: Path, camera: Camera, seed: int) -> None:
    parameters = {
        "camera": {
            "w": camera.width,
            "h": camera.height,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "scale": DEPTH_SCALE,
        },
        "convention": "OpenCV axes, pixel centres at integer coordinates, depth = z",
        "scene": f"procedural room, seed {seed}",
    }
    write_text(path, json.dumps(parameters, indent=1) + "\n")


def _encode(path: Path, camera: Camera, views: Iterator[View]) -> Iterator[View]:
    """Passes the views through and writes them as H.264 video at 30 frames a second."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "16"})
        # The encoder subsamples colour by two, so sides must be even.
        stream.width, stream.height = camera.width // 2 * 2, camera.height // 2 * 2
        stream.pix_fmt = "yuv420p"
        for view in views:
            image = np.ascontiguousarray(view.image[: stream.height, : stream.width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            yield view
        container.mux(stream.encode())
