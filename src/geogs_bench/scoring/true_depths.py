"""True depth of the frames of a sequence: from its depth images, else from its true surface."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.evaluation.surfaces.raster import render_mesh
from geogs.evaluation.surfaces.surface import read_surface
from geogs.geometry.camera import Camera
from geogs.guard.documents import read_json
from geogs.io.pictures import decoded
from geogs.io.sources.frame_source import Source
from geogs.io.sources.sniff import open_source
from geogs.types import Frame, Trajectory
from geogs_bench.data.benchmark_scene import BenchmarkScene
from geogs_bench.data.true_poses import SAME_TIME, read_true_poses
from geogs_bench.results.result_folder import ResultFolder

_SENSOR_REACH = 5.0
"""Largest depth of a sensor that is used, metres."""
_OUTDOORS = ("driving",)
"""Motions of ``geogs synth`` under a sky: pixels without depth are sky."""


@dataclass(frozen=True)
class TrueView:
    """A frame with known depth."""

    index: int
    """Number of the frame in the sequence."""
    timestamp: float
    image: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    """z; 0 where it is unknown, infinite in the sky."""


@dataclass(frozen=True)
class TrueDepths:
    """Frames with depth, in the pixels of a camera."""

    views: list[TrueView]
    camera: Camera
    """Camera of the data set if it gives one; else of the result."""
    is_exact: bool
    """Whether the depth was rendered; else a sensor measured it."""


def read_true_depths(
    scene: BenchmarkScene, result: ResultFolder, poses: Trajectory, most: int
) -> TrueDepths:
    """Read the depth of about ``most`` frames with an estimated pose, spread over the sequence.

    Args:
        scene: with depth images beside its frames, else with true poses and a true surface.
        result: the depths are given for its pixels.
        poses: of the result; frames without one are left out.
        most: frames.

    Raises:
        InputError: there is no depth, or the images have another shape than the result's.
    """
    source = _opened(scene, result)
    frames = [frame for frame in source if _has_pose(frame, poses)]
    if any(frame.depth is not None for frame in frames):
        frames = [frame for frame in frames if frame.depth is not None]
        views = _from_images(scene, source, spread(frames, most))
        return TrueDepths(views, source.camera, source.kind == "replica")
    return TrueDepths(_from_surface(scene, source.camera, frames, most), source.camera, True)


def _opened(scene: BenchmarkScene, result: ResultFolder) -> Source:
    """Open the sequence at the size of the result's images, with its calibration if it has one."""
    camera = result.camera
    config = InputConfig(long_edge=camera.long_edge, depth="auto")
    source = open_source(scene.source, config)
    if source.is_calibration_open:
        told = str(result.path / "intrinsics.json")
        source = open_source(scene.source, replace(config, intrinsics=told))
    own = source.camera
    if (own.width, own.height) != (camera.width, camera.height):
        raise InputError(
            f"{scene.name} gives images of {own.width} x {own.height} pixels, and the result is "
            f"of {camera.width} x {camera.height}; is it of this sequence?"
        )
    return source


def spread(frames: list[Frame], most: int) -> list[Frame]:
    """At most ``most`` frames at equal distances, beginning in the middle of the first interval."""
    count = min(most, len(frames))
    places = ((np.arange(count) + 0.5) * len(frames) / max(count, 1)).astype(int)
    return [frames[place] for place in places]


def _has_pose(frame: Frame, poses: Trajectory) -> bool:
    return bool((np.abs(poses.timestamps - frame.timestamp) < SAME_TIME).any())


def _from_images(scene: BenchmarkScene, source: Source, frames: list[Frame]) -> list[TrueView]:
    is_exact = source.kind == "replica"
    has_sky = _is_outdoors(scene.source)
    views = []
    for frame in frames:
        depth = None if frame.depth is None else frame.depth.metres()
        if depth is None:
            continue
        if has_sky:
            depth = np.where(depth > 0, depth, np.float32(np.inf))
        if not is_exact:
            depth = np.where(depth > _SENSOR_REACH, np.float32(0), depth)
        depth = np.where(_moving(scene.source, frame), np.float32(0), depth)
        views.append(TrueView(frame.index, frame.timestamp, frame.image, depth))
    return views


def _from_surface(
    scene: BenchmarkScene, camera: Camera, frames: list[Frame], most: int
) -> list[TrueView]:
    truth = read_true_poses(scene)
    if truth is None or scene.truth.surface is None:
        raise InputError(f"{scene.name} has neither depth images nor a true surface with poses.")
    surface = read_surface(scene.truth.surface)
    nothing = np.float32(np.inf if _is_outdoors(scene.source) else 0)
    views = []
    for frame in spread([frame for frame in frames if _has_pose(frame, truth)], most):
        T_cw = np.linalg.inv(pose_at(truth, frame.timestamp))
        depth, _ = render_mesh(surface.vertices, surface.faces, camera, T_cw)
        known = np.where(np.isfinite(depth), depth, nothing).astype(np.float32)
        known = np.where(_moving(scene.source, frame), np.float32(0), known)
        views.append(TrueView(frame.index, frame.timestamp, frame.image, known))
    return views


def pose_at(poses: Trajectory, timestamp: float) -> Float64[np.ndarray, "4 4"]:
    """Camera to world of the pose nearest in time."""
    return np.asarray(poses.T_wc[np.abs(poses.timestamps - timestamp).argmin()])


def _is_outdoors(folder: Path) -> bool:
    """Whether the scene of ``geogs synth`` has a sky."""
    file = folder / "cam_params.json"
    document: Any = read_json(file) if file.is_file() else None
    return isinstance(document, dict) and document.get("motion") in _OUTDOORS


def _moving(folder: Path, frame: Frame) -> np.ndarray | bool:
    """Mask of the moving bodies of ``geogs synth``, which are in no map."""
    mask = decoded(folder / "results" / f"moving{frame.index:06d}.png", cv2.IMREAD_GRAYSCALE)
    if mask.picture is None:
        return False
    height, width = frame.image.shape[:2]
    resized = cv2.resize(mask.picture, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized > 0)
