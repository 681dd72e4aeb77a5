"""Pictures of a run that need no truth, drawn by OpenCV, as plotting libraries start slowly."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from geogs.guard.atomic import atomic_file
from geogs.types import RenderedKeyframe, Trajectory

Layer = Literal["image", "depth", "normal", "confidence"]
LAYERS: tuple[Layer, ...] = get_args(Layer)
"""Image layers of a keyframe."""

_INK, _GRID, _PATH, _LOST = (60, 60, 60), (225, 225, 225), (0, 114, 178), (213, 94, 0)
_CELL, _GAP, _HEAD, _BAR = 420, 6, 28, 90
"""Layout of the keyframes' picture in pixels: cell width, gap, head and depth bar."""
_PANEL, _LEFT, _TOP, _BOTTOM = (540, 440), 58, 48, 44
"""Layout of a view of the path in pixels: size and margins."""
_TICKS, _FINE = 6, 4
"""Approximate number of ticks on an axis; fractional bits of OpenCV's pixel coordinates."""


def draw_path(
    path: Path, trajectory: Trajectory, axes: Float[np.ndarray, "3 3"], unit: str = "map units"
) -> None:
    """Draw the camera path from above and the side; lost stretches are marked.

    ``axes`` are rows right, forward and up of the world.
    """
    points = (trajectory.T_wc[:, :3, 3] - trajectory.T_wc[0, :3, 3]) @ axes.T
    names = (("from above", "forward", 1), ("from the side", "up", 2))
    panels = [
        path_panel(points[:, [0, vertical]], ~trajectory.tracked, name, upwards, unit)
        for name, upwards, vertical in names
    ]
    save_picture(path, np.hstack(panels))


def path_panel(
    points: Float[np.ndarray, "n 2"],
    lost: Bool[np.ndarray, "n"],
    name: str,
    upwards: str,
    unit: str = "map units",
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a path on a grid of equal scale, with its start and lost parts."""
    width, height = _PANEL
    panel = np.full((height, width, 3), 255, np.uint8)
    inner = np.array([width - _LEFT - 12, height - _TOP - _BOTTOM], float)
    low, high = points.min(0), points.max(0)
    scale = float((0.9 * inner / np.maximum(high - low, 1e-6)).min())
    middle, centre = (low + high) / 2, np.array([_LEFT, _TOP]) + inner / 2

    def place(p: Float[np.ndarray, "*k 2"]) -> Float[np.ndarray, "*k 2"]:
        return centre + scale * (p - middle) * [1, -1]

    step = tick_step(float(inner.max()) / scale)
    for axis in (0, 1):
        ends = (middle[axis] + np.array([-0.5, 0.5]) * inner[axis] / scale) / step
        for number in range(int(np.ceil(ends[0])), int(np.floor(ends[1])) + 1):
            at = place(np.eye(2)[axis] * (number * step - middle[axis]) + middle)
            _tick(panel, axis, float(at[axis]), f"{number * step:.6g}", inner)
    cv2.polylines(panel, [_fine(place(points))], False, _PATH, 2, cv2.LINE_AA, _FINE)
    for p in _fine(place(points[lost])):
        cv2.circle(panel, p.tolist(), 2 << _FINE, _LOST, -1, cv2.LINE_AA, _FINE)
    (start,) = _fine(place(points[:1])).tolist()
    cv2.circle(panel, start, 5 << _FINE, _PATH, -1, cv2.LINE_AA, _FINE)
    _write(panel, name, (_LEFT, 18), 0.5)
    _write(panel, f"{upwards} ({unit})", (8, 38))
    _write(panel, f"right ({unit})", (width // 2 - 40, height - 8))
    cv2.circle(panel, (width - 170, 14), 5, _PATH, -1, cv2.LINE_AA)
    _write(panel, "start", (width - 160, 18))
    if lost.any():
        cv2.circle(panel, (width - 80, 14), 3, _LOST, -1, cv2.LINE_AA)
        _write(panel, "lost", (width - 70, 18))
    return panel


def tick_step(span: float) -> float:
    """Round step for about six ticks in a span: one, two or five times a power of ten."""
    rough = span / _TICKS
    power = 10.0 ** np.floor(np.log10(rough))
    return float(power * min((1, 2, 5, 10), key=lambda m: abs(np.log(m * power / rough))))


def draw_keyframes(
    path: Path,
    images: Sequence[UInt8[np.ndarray, "ih iw 3"]],
    depths: Sequence[Float[np.ndarray, "h w"]],
    normals: Sequence[Float[np.ndarray, "h w 3"]],
    unit: str = "map units",
) -> None:
    """Draw one row per keyframe: image, rendered depth (one colour scale for all) and normals.

    Depth is white where it is 0 or not finite; normals (camera frame) show x, y, z as red, green,
    blue, from -1 dark to 1 bright; surfaces that face the camera are bright blue.
    """
    low, high = _depth_range(depths)
    height = max(round(_CELL * images[0].shape[0] / images[0].shape[1]), 1)
    rows = len(images)
    width = 3 * _CELL + 2 * _GAP
    picture = np.full((_HEAD + rows * (height + _GAP), width + _BAR, 3), 255, np.uint8)
    for row, (image, depth, normal) in enumerate(zip(images, depths, normals, strict=True)):
        shown = (image, depth_colours(depth, low, high), normal_colours(normal))
        top = _HEAD + row * (height + _GAP)
        for column, cell in enumerate(shown):
            left = column * (_CELL + _GAP)
            is_smaller = cell.shape[1] > _CELL
            way = cv2.INTER_AREA if is_smaller else cv2.INTER_NEAREST
            fitted = cv2.resize(cell, (_CELL, height), interpolation=way)
            picture[top : top + height, left : left + _CELL] = fitted
    for column, title in enumerate(("image", "depth", "normals")):
        _write(picture, title, (column * (_CELL + _GAP) + 4, 19), 0.5)
    _depth_bar(picture[:, width + 10 :], low, high, unit)
    save_picture(path, picture)


def _depth_range(depths: Sequence[Float[np.ndarray, "h w"]]) -> tuple[float, float]:
    """1st and 99th percentile of the known depths; 0 and 1 where there is none."""
    known = np.concatenate(
        [np.zeros(0, np.float32), *(d[np.isfinite(d) & (d > 0)] for d in depths)]
    )
    low, high = np.quantile(known, [0.01, 0.99]) if len(known) else (0.0, 1.0)
    return float(low), float(high)


def depth_colours(
    depth: Float[np.ndarray, "h w"], low: float, high: float, background: int = 255
) -> UInt8[np.ndarray, "h w 3"]:
    """Depth from blue, near, to red, far; white or black where there is none."""
    is_known = np.isfinite(depth) & (depth > 0)
    fraction = (np.where(is_known, depth, low) - low) / max(high - low, 1e-12)
    levels = (255 * fraction.clip(0, 1)).round().astype(np.uint8)
    colours = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(is_known[..., None], colours, np.uint8(background))


def normal_colours(
    normal: Float[np.ndarray, "h w 3"], background: int = 255
) -> UInt8[np.ndarray, "h w 3"]:
    """Normals of the camera's frame as colours; grey or white where there is none."""
    is_known = np.linalg.norm(normal, axis=-1, keepdims=True) > 0.5
    colours = (255 * (0.5 + 0.5 * normal * [1, -1, -1]).clip(0, 1)).round().astype(np.uint8)
    return np.where(is_known, colours, np.uint8(background))


def layer_picture(keyframe: RenderedKeyframe, layer: Layer) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of one layer, RGB; black where nothing is known.

    Depth goes from blue, near, to red, far (1st to 99th percentile); normals show x, y, z of the
    camera as red, green, blue; surfaces that face the camera are bright blue; confidence is white.
    """
    match layer:
        case "image":
            if keyframe.image is None:
                return np.zeros((*keyframe.depth.shape, 3), np.uint8)
            return keyframe.image
        case "depth":
            depth = keyframe.depth.cpu().numpy()
            return depth_colours(depth, *_depth_range([depth]), background=0)
        case "normal":
            return normal_colours(keyframe.normal.cpu().numpy(), background=0)
        case "confidence":
            weight = keyframe.weight.cpu().numpy()
            grey = (255 * weight.clip(0, 1)).round().astype(np.uint8)
            return np.repeat(grey[..., None], 3, -1)


def _depth_bar(place: UInt8[np.ndarray, "h w 3"], low: float, high: float, unit: str) -> None:
    """Draw the colour bar of depth into a strip of the picture."""
    top = _HEAD + 20
    length = min(place.shape[0] - _HEAD - 40, 300)
    if length < 20:
        return
    ramp = np.linspace(high, low, length)[:, None].repeat(14, 1)
    place[top : top + length, :14] = depth_colours(np.maximum(ramp, 1e-12), low, high)
    _write(place, unit, (0, top - 8), 0.38)
    for fraction in (0.0, 0.5, 1.0):
        value = f"{high + fraction * (low - high):.3g}"
        _write(place, value, (18, round(top + fraction * (length - 1)) + 4))


def _tick(
    panel: UInt8[np.ndarray, "h w 3"], axis: int, at: float, text: str, inner: np.ndarray
) -> None:
    """Draw a grid line with its number; ``at`` is its position on the axis, in pixels."""
    where = round(at)
    right = _LEFT + int(inner[0])
    bottom = _TOP + int(inner[1])
    if axis == 0 and _LEFT <= where <= right:
        cv2.line(panel, (where, _TOP), (where, bottom), _GRID, 1)
        _write(panel, text, (where - 4 * len(text), bottom + 16))
    elif axis == 1 and _TOP <= where <= bottom:
        cv2.line(panel, (_LEFT, where), (right, where), _GRID, 1)
        _write(panel, text, (_LEFT - 6 - 8 * len(text), where + 4))


def _fine(points: Float[np.ndarray, "n 2"]) -> np.ndarray:
    """Points in OpenCV's fixed-point pixel coordinates."""
    return np.round(points * (1 << _FINE)).astype(np.int32)


def _write(
    picture: UInt8[np.ndarray, "h w 3"], text: str, at: tuple[int, int], size: float = 0.42
) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, _INK, 1, cv2.LINE_AA)


def save_picture(path: Path, picture: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a picture (RGB) as PNG, completely or not at all."""
    data = cv2.imencode(".png", picture[..., ::-1])[1]
    with atomic_file(path) as stream:
        stream.write(data.tobytes())
