"""Known lengths in metres, as given by ``--scale-from``, and the scale of a map by them.

Known distances are those between the points at two pixels of a frame, by the depth of the map.
"""

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float64

from geogs.application.progress.run_progress import RunProgress
from geogs.application.scale.measurable_scene import (
    MeasurableScene,
    SeenKeyframe,
    measurable,
    scale_sentence,
)
from geogs.application.scale.tags import TagSize, scale_by_tags
from geogs.errors import InputError
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.frame_source import Source
from geogs.on_demand import OnDemand
from geogs.tracking.graph.measured_odometry import OdometryAgreement
from geogs.types import MetricScale

if TYPE_CHECKING:
    from geogs.slam import Slam


MAX_TILT = np.radians(35.0)
"""Largest angle between the ground's normal and the mean of the cameras' upward axes."""
MAX_DISTANCE = 0.02
"""Largest distance of a ground point from the plane, relative to the cameras' height."""


@dataclass(frozen=True)
class CameraHeight:
    """Median height of the camera over the ground."""

    metres: float


def scale_by_height(scene: MeasurableScene, known: CameraHeight) -> MetricScale:
    """The median height of the keyframes over the ground, which is found by RANSAC.

    The deviation is the spread of the heights over the path: a hand-held camera moves up and down.

    Raises:
        InputError: there is no such plane.
    """
    # Largest number of keyframes whose surfaces are used.
    step = max(1, -(-len(scene.keyframes) // 40))
    poses = np.array([k.T_cw for k in scene.keyframes])
    if not len(poses):
        raise InputError("--scale-from: there is no keyframe, and so no ground.")
    rng = np.random.default_rng(0)
    clouds = []
    for T_cw in poses[::step]:
        points, _ = scene.points(T_cw)
        # Number of points of each keyframe.
        chosen = rng.choice(len(points), min(400, len(points)), replace=False)
        clouds.append(points[chosen])
    cloud = np.concatenate(clouds)
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    up = -poses[:, 1, :3].mean(0)
    plane = ground_plane(cloud, centres, up, rng)
    if plane is None:
        raise InputError(
            "--scale-from: no ground was found under the camera's path; let it be seen, or give "
            "another known length."
        )
    heights = centres @ plane[:3] + plane[3]
    height = float(np.median(heights))
    spread = 1.4826 * float(np.median(np.abs(heights - height))) / height
    origin = f"a camera height of {known.metres:g} m"
    return MetricScale(origin, known.metres / height, float(np.hypot(spread, 0.005)))


def ground_plane(
    cloud: Float64[np.ndarray, "n 3"],
    centres: Float64[np.ndarray, "k 3"],
    up: Float64[np.ndarray, "3"],
    rng: np.random.Generator,
) -> Float64[np.ndarray, "4"] | None:
    """Unit normal n, upward, and offset of the plane ``n . x + offset = 0`` below all cameras.

    The one with most points among those with hardly any points below; None if there is none.
    """
    if len(cloud) < 3:
        return None
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    # Largest number of points to score a plane by.
    judges = cloud[rng.permutation(len(cloud))[:3000]]
    best = None
    # Least fraction of points on the ground.
    most = 0.03 * len(judges)
    for a, b, c in cloud[rng.integers(len(cloud), size=(1000, 3))]:
        plane = _through(a, b, c, up)
        count = 0.0 if plane is None else _support(plane, judges, centres)
        if count > most:
            best = plane
            most = count
    if best is None:
        return None
    for _ in range(3):
        height = float(np.median(centres @ best[:3] + best[3]))
        near = cloud[np.abs(cloud @ best[:3] + best[3]) < MAX_DISTANCE * height]
        middle = near.mean(0)
        normal = np.linalg.svd(near - middle, full_matrices=False)[2][2]
        normal = normal if normal @ up > 0 else -normal
        best = np.append(normal, -normal @ middle)
    return best


def _through(
    a: Float64[np.ndarray, "3"],
    b: Float64[np.ndarray, "3"],
    c: Float64[np.ndarray, "3"],
    up: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "4"] | None:
    normal = np.cross(b - a, c - a)
    length = float(np.linalg.norm(normal))
    if length < 1e-12:
        return None
    normal = normal / length if normal @ up > 0 else -normal / length
    return np.append(normal, -normal @ a) if normal @ up > np.cos(MAX_TILT) else None


def _support(
    plane: Float64[np.ndarray, "4"],
    cloud: Float64[np.ndarray, "n 3"],
    centres: Float64[np.ndarray, "k 3"],
) -> float:
    """Number of points on a plane; 0 where a camera is not above it, or many points lie below."""
    heights = centres @ plane[:3] + plane[3]
    height = float(np.median(heights))
    if heights.min() <= 0:
        return 0.0
    above = cloud @ plane[:3] + plane[3]
    # Largest fraction of points clearly below the ground.
    if (above < -4 * MAX_DISTANCE * height).mean() > 0.05:
        return 0.0
    return float((np.abs(above) < MAX_DISTANCE * height).sum())


_RADIUS = 2
"""Half-width of the window of the depth map around a given pixel, in pixels."""


@dataclass(frozen=True)
class KnownDistance:
    """Two pixels of a frame with the distance of their points."""

    frame: int
    """Number of the frame in the source's selection, from 0."""
    first: tuple[float, float]
    """Column and row in the stored image, upright."""
    second: tuple[float, float]
    metres: float


@dataclass(frozen=True)
class KnownDistances:
    """Several distances, which are averaged."""

    each: tuple[KnownDistance, ...]


def scale_by_distances(
    scene: MeasurableScene, known: KnownDistances, calibration: Calibration
) -> MetricScale:
    """The mean scale of the distances, weighted by their inverse variances.

    Args:
        scene: the map to scale.
        known: pixels of stored images.
        calibration: camera of these images.

    Raises:
        InputError: a frame or a pixel does not exist, or the map has no depth at it.
    """
    each = [_one(scene, one, calibration) for one in known.each]
    factors, deviations = np.array(each).T
    weight = deviations**-2.0
    factor = float((weight * factors).sum() / weight.sum())
    deviation = weight.sum() ** -0.5
    if len(each) > 1:  # their disagreement includes errors that depth maps do not report
        chi = float((weight * (factors - factor) ** 2).sum() / (len(each) - 1))
        deviation *= max(1.0, chi) ** 0.5
    count = "a known distance" if len(each) == 1 else f"{len(each)} known distances"
    return MetricScale(count, factor, float(deviation / factor))


def _one(
    scene: MeasurableScene, known: KnownDistance, calibration: Calibration
) -> tuple[float, float]:
    """Metres per map unit by one distance, and its deviation."""
    trajectory = scene.trajectory
    if known.frame >= len(trajectory.T_wc) or not trajectory.tracked[known.frame]:
        raise InputError(
            f"--scale-from: frame {known.frame} has no place; give one of the "
            f"{len(trajectory.T_wc)} frames that was tracked."
        )
    depth = scene.surface(np.linalg.inv(trajectory.T_wc[known.frame]))
    both = torch.tensor([known.first, known.second], dtype=torch.float64)
    rays = calibration.camera().plane(both).numpy()
    ends, along = zip(*(_lifted(scene, depth, ray, known) for ray in rays), strict=True)
    between = ends[1] - ends[0]
    length = float(np.linalg.norm(between))
    focal = calibration.fx
    variance = 0.0
    for point, ray, deviation in zip(ends, rays, along, strict=True):
        # A given point is right to one pixel of the stored image.
        variance += (point[2] / focal) ** 2
        towards = np.append(ray, 1.0) @ between / length
        variance += (towards * deviation) ** 2
    return known.metres / length, known.metres / length * variance**0.5 / length


def _lifted(
    scene: MeasurableScene,
    depth: Float64[np.ndarray, "h w"],
    ray: Float64[np.ndarray, "2"],
    known: KnownDistance,
) -> tuple[Float64[np.ndarray, "3"], float]:
    """The point on a ray in the camera, and the deviation of its depth.

    Inverse depth is fitted by a plane to the pixels around, without those of another surface.
    """
    camera = scene.depth_camera
    u, v = ray[0] * camera.fx + camera.cx, ray[1] * camera.fy + camera.cy
    column, row = round(float(u)), round(float(v))
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise InputError(f"--scale-from: a pixel lies outside the working image of {known.frame}.")
    rows = slice(max(row - _RADIUS, 0), row + _RADIUS + 1)
    columns = slice(max(column - _RADIUS, 0), column + _RADIUS + 1)
    y, x = np.mgrid[rows, columns]
    y, x = y[: depth[rows, columns].shape[0]], x[:, : depth[rows, columns].shape[1]]
    near = depth[rows, columns]
    middle = np.median(near[near > 0]) if (near > 0).any() else 0.0
    used = (near > 0) & (np.abs(near - middle) < 0.05 * middle)
    if used.sum() < 4:
        raise InputError(
            f"--scale-from: the map has no depth at a pixel of frame {known.frame}; give points "
            "on surfaces that are mapped."
        )
    A = np.stack([np.ones(used.sum()), x[used] - u, y[used] - v], 1)
    inverse = 1 / near[used]
    fit = np.linalg.lstsq(A, inverse, rcond=None)[0]
    z = 1 / fit[0]
    noise = float(np.sqrt(np.mean((A @ fit - inverse) ** 2))) * z * z
    return np.append(ray, 1.0) * z, max(noise, 1e-3 * z)


_NUMBER = r"([-+]?[0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)"
_DISTANCE = re.compile(rf"(\d+):{_NUMBER},{_NUMBER},{_NUMBER},{_NUMBER}={_NUMBER}m?")
_TAG = re.compile(rf"aruco:(DICT_\w+):{_NUMBER}m?")
_HEIGHT = re.compile(rf"height:{_NUMBER}m?")
HOW = (
    "give FRAME:u1,v1,u2,v2=1.25m, several of them with semicolons, aruco:DICT_5X5_50:0.12, "
    "height:1.6 or sensor"
)
"""Hint in error messages."""


@dataclass(frozen=True)
class SensorScale:
    """The scale of a depth sensor."""


KnownLength = KnownDistances | TagSize | CameraHeight
"""Known lengths that a map can be scaled by."""


def find_scale(scene: MeasurableScene, known: KnownLength, calibration: Calibration) -> MetricScale:
    """Estimate metres per map unit; ``calibration`` is that of the stored images.

    Raises InputError where the scene does not determine it.
    """
    match known:
        case KnownDistances():
            return scale_by_distances(scene, known, calibration)
        case TagSize():
            return scale_by_tags(scene, known)
        case CameraHeight():
            return scale_by_height(scene, known)


def scale_source(text: str) -> KnownLength | SensorScale | None:
    """Parse ``--scale-from``; none where it is empty. Raises InputError for a wrong text."""
    text = text.strip()
    if not text:
        return None
    if text == "sensor":
        return SensorScale()
    if found := _TAG.fullmatch(text):
        return TagSize(found[1], _length(text, found[2]))
    if found := _HEIGHT.fullmatch(text):
        return CameraHeight(_length(text, found[1]))
    parts = [_DISTANCE.fullmatch(part.strip()) for part in text.split(";") if part.strip()]
    if not parts or None in parts:
        raise InputError(f"--scale-from {text[:60]} is not understood; {HOW}.")
    return KnownDistances(tuple(_distance(text, found) for found in parts if found is not None))


def _distance(text: str, found: re.Match[str]) -> KnownDistance:
    u1, v1, u2, v2 = (float(found[k]) for k in range(2, 6))
    if (u1, v1) == (u2, v2):
        raise InputError(f"--scale-from {text[:60]} has one pixel twice; give two.")
    return KnownDistance(int(found[1]), (u1, v1), (u2, v2), _length(text, found[6]))


def _length(text: str, number: str) -> float:
    metres = float(number)
    if not 0 < metres < 1e6:
        raise InputError(f"--scale-from {text[:60]} has a length of {metres:g} m; give a real one.")
    return metres


def make_metric(
    slam: "Slam", stream: Source, source: KnownLength | SensorScale | None, progress: RunProgress
) -> None:
    """Scale the map to metres by a known length; if that fails, report it and leave the map."""
    if not slam.segments.keyframe_ids:
        return
    for sentence in sentences_on_poses(slam.segments.main.map.odometry.agreement()):
        progress.write(sentence)
    if source is None:
        slam.to_metres()
        return
    if isinstance(source, SensorScale):
        if slam.metric_scale is None:
            progress.write("warning: the scale is unknown: the map was not started from depth.")
        return
    try:
        found = find_scale(measurable_run(slam), source, stream.calibration)
    except InputError as why:
        progress.write(f"warning: the scale stays unknown. {why}")
        return
    slam.rescale(found)
    progress.write(scale_sentence(found))


def sentences_on_poses(found: OdometryAgreement) -> list[str]:
    """Sentences on the use of pose priors; none without them."""
    if not found.motions:
        return []
    fitting = f"{found.fitting:.0%} of {found.motions} motions between keyframes"
    if found.used:
        return [f"Poses beside the images: {fitting} fit what the images show."]
    return [
        f"warning: the poses beside the images are not used: only {fitting} fit what the images "
        "show. Are they of this video? --poses none leaves them out."
    ]


def measurable_run(slam: "Slam") -> MeasurableScene:
    """The map of a run for the estimation of its scale."""

    def seen(id: int) -> SeenKeyframe:
        keyframe = slam.world.keyframes[id]
        return SeenKeyframe(keyframe.T_cw.numpy(), keyframe.image)

    keyframes = OnDemand(slam.segments.keyframe_ids, seen)
    return measurable(slam.camera, slam.renderer(), keyframes, slam.trajectory())
