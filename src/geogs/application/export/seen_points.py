"""Points of the surface with the keyframes that see them."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.lie import transform
from geogs.io.writers.exports.exported import SeenPoints
from geogs.types import RenderedKeyframe


def seen_points(keyframes: Sequence[RenderedKeyframe], camera: Camera, count: int) -> SeenPoints:
    """About ``count`` points from the keyframes' depths that two keyframes or more see.

    A keyframe sees a point that projects onto its depth map within 1 % of the depth there and faces
    it. ``camera`` is that of the images; observations are in its pixels.

    Raises:
        InputError: a keyframe has no image, or no two of them see the same surface.
    """
    positions, normals, colours = _sampled(keyframes, count, np.random.default_rng(0))
    observed = [_observed(positions, normals, keyframe) for keyframe in keyframes]
    point = np.concatenate([index for index, _ in observed])
    image = np.repeat(np.arange(len(observed)), [len(index) for index, _ in observed])
    at = np.concatenate([pixels for _, pixels in observed])
    kept = np.bincount(point, minlength=len(positions)) >= 2
    if not kept.any():
        raise InputError("No two keyframes see the same surface; there are no points to export.")
    number = np.cumsum(kept) - 1
    stays = np.flatnonzero(kept[point])
    stays = stays[np.argsort(point[stays], kind="stable")]
    own = keyframes[0].camera
    scale = np.array([camera.fx / own.fx, camera.fy / own.fy])
    return SeenPoints(
        positions[kept],
        normals[kept].astype(np.float32),
        colours[kept],
        number[point[stays]],
        image[stays].astype(np.int64),
        (at[stays] - [own.cx, own.cy]) * scale + [camera.cx, camera.cy],
    )


def cloud(keyframes: Sequence[RenderedKeyframe]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Point cloud of all confident depths: positions, normals and colours.

    One point is kept per voxel, whose edge is the size of a pixel at the median depth.

    Raises:
        InputError: there is no depth, or a keyframe has no image.
    """
    parts = [_lifted(keyframe, _confident(keyframe)) for keyframe in keyframes]
    positions, normals, colours = (np.concatenate(part) for part in zip(*parts, strict=True))
    if not len(positions):
        raise InputError("The map shows no surface; there are no points to export.")
    depths = [k.depth[k.depth > 0].median() for k in keyframes if bool((k.depth > 0).any())]
    edge = float(torch.stack(depths).median()) / keyframes[0].camera.fx
    _, first = np.unique(np.floor(positions / edge).astype(np.int64), axis=0, return_index=True)
    first.sort()
    return positions[first], normals[first].astype(np.float32), colours[first]


def _sampled(
    keyframes: Sequence[RenderedKeyframe], count: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random points of all depth maps: positions, normals, colours."""
    each = max(1, -(-count // max(len(keyframes), 1)))
    parts = []
    for keyframe in keyframes:
        chosen = _confident(keyframe)
        chosen = np.sort(random.choice(chosen, min(each, len(chosen)), replace=False))
        parts.append(_lifted(keyframe, chosen))
    if not parts:
        raise InputError("The result has no keyframes.")
    positions, normals, colours = (np.concatenate(part) for part in zip(*parts, strict=True))
    return positions, normals, colours


def _confident(keyframe: RenderedKeyframe) -> Int64[np.ndarray, "n"]:
    """Pixels whose ray meets one surface, counted row by row."""
    confident = (keyframe.weight >= 1) & (keyframe.depth > 0)
    return np.flatnonzero(confident.cpu().numpy())


def _lifted(
    keyframe: RenderedKeyframe, pixels: Int64[np.ndarray, "n"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World positions and normals of some pixels, and their colours in the image."""
    if keyframe.image is None:
        raise InputError("The result was written without keyframe images, which this needs.")
    camera = keyframe.camera
    T_cw = keyframe.T_cw.numpy()
    v, u = np.divmod(pixels, camera.width)
    z = keyframe.depth.cpu().numpy()[v, u].astype(np.float64)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], 1)
    positions = (rays * z[:, None] - T_cw[:3, 3]) @ T_cw[:3, :3]
    normals = keyframe.normal.cpu().numpy()[v, u] @ T_cw[:3, :3]
    height, width = keyframe.image.shape[:2]
    row = np.round((v + 0.5) * height / camera.height - 0.5).astype(int).clip(0, height - 1)
    column = np.round((u + 0.5) * width / camera.width - 0.5).astype(int).clip(0, width - 1)
    return positions, normals, keyframe.image[row, column]


def _observed(
    positions: Float64[np.ndarray, "n 3"], normals: np.ndarray, keyframe: RenderedKeyframe
) -> tuple[Int64[np.ndarray, "k"], Float64[np.ndarray, "k 2"]]:
    """Indices of the points that a keyframe sees, and their pixels in its depth map."""
    camera = keyframe.camera
    T_cw = keyframe.T_cw
    points = transform(T_cw, torch.from_numpy(positions))
    pixels, z = camera.project(points)
    u, v = pixels.round().long().unbind(-1)
    inside = (z > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    index = inside.nonzero()[:, 0]
    depth = keyframe.depth.cpu().double()[v[index], u[index]]
    # Largest relative difference of depth for a keyframe to see a point.
    agrees = (depth - z[index]).abs() < 0.01 * z[index]
    facing = _cosines(points[index], torch.from_numpy(normals)[index], T_cw) > 0.1
    index = index[agrees & facing]
    return index.numpy(), pixels[index].numpy()


def _cosines(
    points: Float[Tensor, "k 3"], normals: Float[Tensor, "k 3"], T_cw: Float[Tensor, "4 4"]
) -> Float[Tensor, "k"]:
    """Cosines of the angles between normals in the world and the rays back to the camera."""
    rays = torch.nn.functional.normalize(points, dim=-1)
    return -(rays * (normals @ T_cw[:3, :3].mT.to(normals))).sum(-1)
