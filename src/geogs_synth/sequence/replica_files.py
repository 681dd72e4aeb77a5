"""Writes a synthetic sequence with its ground truth in the layout of Replica."""

import json
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from geogs.errors import InputError, OutputError
from geogs.geometry.camera import Camera
from geogs.guard.atomic import atomic_file, prepare_output_folder, write_text
from geogs.io.pose_files import FRAMES_PER_SECOND
from geogs.io.writers.ply_writer import write_mesh, write_points
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.types import Trajectory
from geogs_synth.camera.flaws import Flaws
from geogs_synth.camera.radial_camera import RadialCamera
from geogs_synth.camera.sensors import DepthSensor
from geogs_synth.motion.motion_kinds import LampKind, MotionKind
from geogs_synth.motion.room_motions import Motion
from geogs_synth.raycast.raycaster import Raycaster
from geogs_synth.scene.light_changes import switched_by_thirds
from geogs_synth.scene.textured_scene import Scene, scene_mesh
from geogs_synth.sequence.location import Location, make_location
from geogs_synth.sequence.shooting import Shooting, Shot

# Level 1 is four times faster than the default and a few percent larger.
_FAST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_ENCODING = {"crf": "16", "x264-params": "mbtree=0"}
"""High quality, and reproducible: x264's macroblock tree would differ each time."""


def write_sequence(
    folder: Path | str,
    frames: int = 120,
    width: int | None = None,
    height: int | None = None,
    seed: int = 0,
    *,
    motion: MotionKind = "handheld",
    flaws: Flaws | None = None,
    moving: float = 0.0,
    lamps: LampKind = "steady",
    depth: bool = True,
    depth_sensor: DepthSensor | None = None,
    image_format: str = "jpg",
    video: bool = False,
    threads: int = 2,
    raycaster: Raycaster | None = None,
    on_frame: Callable[[int], None] = lambda index: None,
) -> None:
    """Render a scene and write images, depths, poses, intrinsics and the true surface.

    Files: ``results/frame%06d.jpg`` (or png), ``results/depth%06d.png`` (z; the intrinsics hold the
    units per metre), ``traj.txt`` (camera to world, one row-major 4x4 a line), ``cam_params.json``,
    ``mesh.ply`` (the whole scene), ``points_seen_1cm.ply`` (the surface that the camera saw), and
    ``video.mp4`` if ``video`` is set. Where the motion has not 30 frames a second, ``rgb.txt`` and
    ``groundtruth.txt`` hold the times, in the layout of TUM. Depth and poses are those of the
    middle row at mid-exposure, whatever the flaws; a ``depth_sensor`` adds its own. With
    ``moving``, bodies that cover about this fraction of the image cross the view: they are in the
    images and the depths, but in neither the mesh nor the points, and ``results/moving%06d.png`` is
    white where the depth is theirs. Where the ``lamps`` are switched, each third of the sequence
    shows the scene in another light.
    A given ``raycaster`` of the same scene is used instead of a new one. ``on_frame`` is called
    after each frame.

    Raises:
        InputError: the options cannot be rendered.
        OutputError: the folder cannot be written.
    """
    if image_format not in ("jpg", "png"):
        raise InputError(f"images can be written as jpg or png, not {image_format}")
    if frames < 1:
        raise InputError(f"a sequence needs at least 1 frame, not {frames}")
    flaws = flaws or Flaws()
    location = make_location(motion, seed, raycaster.scene if raycaster else None)
    rate = location.motion.rate
    if frames / rate > location.motion.seconds:
        most = math.floor(location.motion.seconds * rate)
        raise InputError(f"{motion} ends after {most} frames; ask for no more than that")
    lens = RadialCamera(location.camera(width, height), flaws.k1, flaws.k2)
    folder = prepare_output_folder(folder)
    results = prepare_output_folder(folder / "results")
    _write_camera(folder / "cam_params.json", location, lens, flaws, moving, lamps)
    _write_trajectory(folder, location.motion, frames, image_format)
    write_mesh(folder / "mesh.ply", *scene_mesh(location.scene))
    bodies = location.bodies(lens.camera, frames / rate, moving) if moving else []
    raycaster = (raycaster or Raycaster(location.scene, threads)).with_bodies(bodies)
    if lamps == "switched":
        lights = len(location.scene.lights)
        raycaster = raycaster.with_lights(switched_by_thirds(lights, frames / rate))
    shooting = Shooting(raycaster, lens, location.motion.path, flaws, rate, seed)
    quality = 95 if flaws.jpeg is None else flaws.jpeg
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if image_format == "jpg" else []

    def shoot(index: int) -> Shot:
        shot = shooting.shoot(index)
        bgr = cv2.cvtColor(shot.image, cv2.COLOR_RGB2BGR)
        _write_image(results / f"frame{index:06d}.{image_format}", bgr, options)
        if depth:
            metres = shot.truth.depth
            if depth_sensor is not None:
                metres = depth_sensor.measure(metres, lens.camera.fx, seed, index)
            units = np.rint(metres * location.depth_scale)
            units = np.where(units > 65535, 0, units).astype(np.uint16)
            _write_image(results / f"depth{index:06d}.png", units, _FAST_PNG)
        if moving:
            mask = np.where(shot.moving, 255, 0).astype(np.uint8)
            _write_image(results / f"moving{index:06d}.png", mask, _FAST_PNG)
        return shot

    seen = SeenSurface(location.scene, lens, location.voxel_cm / 100)
    with ThreadPoolExecutor(threads) as pool:
        shots = pool.map(shoot, range(frames))
        if video:
            shots = _encode(folder / "video.mp4", lens.camera, rate, shots)
        for index, shot in enumerate(shots):
            away = shot.moving | (shot.truth.depth > location.reach)
            seen.add(np.where(away, 0, shot.truth.depth), shot.T_wc)
            on_frame(index)
    write_points(folder / f"points_seen_{location.voxel_cm}cm.ply", seen.points)


class SeenSurface:
    """The surface points in the depth maps of one camera, one to a voxel."""

    def __init__(self, scene: Scene, camera: Camera | RadialCamera, voxel: float = 0.01) -> None:
        x, y = RadialCamera.of(camera).rays
        self._rays = np.stack([x, y, np.ones_like(x)], -1)
        self._voxel = voxel
        # A cell of margin, since walls lie exactly on the border.
        self._shape = np.ceil(scene.size / voxel).astype(np.int64) + 2
        self._filled = np.zeros(int(self._shape.prod()), bool)
        self._points: list[Float32[np.ndarray, "k 3"]] = []

    def add(self, depth: Float32[np.ndarray, "h w"], T_wc: Float64[np.ndarray, "4 4"]) -> None:
        """Add the back-projected pixels that fall into voxels of the scene empty so far."""
        seen = depth > 0
        points = (depth[..., None] * self._rays)[seen] @ T_wc[:3, :3].T + T_wc[:3, 3]
        cell = (points / self._voxel).astype(np.int32) + 1
        inside = ((cell >= 0) & (cell < self._shape)).all(1)
        points = points[inside]
        x, y, z = cell[inside].T
        key = (z * self._shape[1] + y) * self._shape[0] + x
        fresh = np.flatnonzero(~self._filled[key])
        key, first = np.unique(key[fresh], return_index=True)
        self._filled[key] = True
        self._points.append(points[fresh[first]].astype(np.float32))

    @property
    def points(self) -> Float32[np.ndarray, "n 3"]:
        """World points in metres."""
        return np.concatenate([np.empty((0, 3), np.float32), *self._points])


def _write_image(path: Path, image: np.ndarray, options: list[int]) -> None:
    try:
        path.write_bytes(cv2.imencode(path.suffix, image, options)[1].tobytes())
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError(f"{path} cannot be written ({reason}); free some space.") from error


def _encode(path: Path, camera: Camera, rate: float, shots: Iterator[Shot]) -> Iterator[Shot]:
    """Pass the shots through and write them as H.264 video."""
    import av

    with av.open(str(path), "w") as container:
        fps = Fraction(rate).limit_denominator(1000)
        stream = container.add_stream("libx264", rate=fps, options=_ENCODING)
        # The encoder subsamples colour by two, so sides must be even.
        stream.width, stream.height = camera.width // 2 * 2, camera.height // 2 * 2
        stream.pix_fmt = "yuv420p"
        for shot in shots:
            image = np.ascontiguousarray(shot.image[: stream.height, : stream.width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            yield shot
        container.mux(stream.encode())


def _write_camera(
    path: Path, location: Location, lens: RadialCamera, flaws: Flaws, moving: float, lamps: LampKind
) -> None:
    """Write the intrinsics, with the distortion, for programs; the rest is for evaluation."""
    c = lens.camera
    intrinsics: dict[str, Any] = {
        "w": c.width,
        "h": c.height,
        "fx": c.fx,
        "fy": c.fy,
        "cx": c.cx,
        "cy": c.cy,
        "scale": location.depth_scale,
    }
    if lens.is_distorted:
        intrinsics["distortion"] = [lens.k1, lens.k2, 0.0, 0.0]
    parameters: dict[str, Any] = {
        "camera": intrinsics,
        "convention": "OpenCV axes, pixel centres at integer coordinates, depth = z",
        "scene": location.name,
    }
    if flaws != Flaws() or moving or lamps != "steady" or location.kind != "handheld":
        parameters |= {
            "motion": location.kind,
            "fps": location.motion.rate,
            "readout": flaws.readout,
            "flaws": asdict(flaws),
            "moving": moving,
            "lamps": lamps,
        }
    write_text(path, json.dumps(parameters, indent=1) + "\n")


def _write_trajectory(folder: Path, motion: Motion, frames: int, image_format: str) -> None:
    """Write ``traj.txt`` and, where the frame rate is not the usual one, lists of TUM."""
    times = np.arange(frames) / motion.rate
    T_wc = motion.path(times)
    with atomic_file(folder / "traj.txt") as stream:
        np.savetxt(stream, T_wc.reshape(-1, 16), fmt="%.9f")
    # A list of an earlier sequence in this folder would be used.
    if motion.rate != FRAMES_PER_SECOND or (folder / "rgb.txt").exists():
        names = (f"results/frame{index:06d}.{image_format}" for index in range(frames))
        lines = (f"{time:.6f} {name}\n" for time, name in zip(times, names, strict=True))
        write_text(folder / "rgb.txt", "".join(lines))
        poses = Trajectory(np.round(times, 6), T_wc, np.ones(frames, bool))
        write_tum_trajectory(folder / "groundtruth.txt", poses)
