"""A part of a join: a finished result, and its keyframes resampled to one common camera."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8

from geogs.application.results.saved_result import SavedResult, load_result
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.writers.keyframe_folder import image_path, read_image
from geogs.loop.orb_features import orb_features
from geogs.threads import on_one_torch_thread
from geogs.world.grid import SampleGrid
from geogs.world.loops import ImageFeatures
from geogs_fleet.join.records import write_record

DEVIATION = 0.01
"""Relative standard deviation of a depth that a map was trained on."""
Node = tuple[int, int]
"""A keyframe: the number of its part, and its index among the part's keyframes."""


@dataclass(frozen=True)
class Part:
    """A result to be joined with others."""

    name: str
    """Name, unique among the parts."""
    folder: Path
    """Result of ``geogs run``."""


@dataclass(frozen=True)
class PartViews:
    """The keyframes of a part, in its own world, on the grid of one camera."""

    T_cw: Float64[np.ndarray, "n 4 4"]
    """World of the part to camera."""
    timestamp: Float64[np.ndarray, "n"]
    """Seconds, in the part's own time."""
    inverse_depth: Float32[np.ndarray, "n p"]
    """On the grid; rendered from the part's map, filled where the map is empty."""
    information: Float32[np.ndarray, "n p"]
    """Inverse variances of these; 0 where the map is empty."""
    features: tuple[ImageFeatures, ...]

    @property
    def median_depth(self) -> Float64[np.ndarray, "n"]:
        """Median depth of each keyframe."""
        return 1 / np.median(self.inverse_depth, axis=1).astype(np.float64)

    def outline(self) -> "PartViews":
        """Reduce to one depth a keyframe and no features: all parts then fit into memory."""
        middle = np.median(self.inverse_depth, axis=1, keepdims=True)
        return PartViews(self.T_cw, self.timestamp, middle, 0 * middle, ())


@on_one_torch_thread
def describe(part: Part, camera: Camera, file: Path, device: str = "cpu") -> int:
    """Find the features of a part's keyframes, render their depths, and write both to a file.

    Both are in the pixels of ``camera``, common to all parts. Returns the number of keyframes.
    Raises InputError if the result has no images, or is damaged.
    """
    result = opened(part, device)
    grid = SampleGrid(camera)
    depths = []
    known = []
    features = []
    for number, T_cw in enumerate(torch.from_numpy(result.views.T_cw)):
        features.append(orb_features(image_of(result, number, camera)))
        inverse, information = _on_grid(result, T_cw, grid)
        depths.append(inverse)
        known.append(information)
    views = PartViews(
        result.views.T_cw,
        result.views.timestamp,
        np.stack(depths),
        np.stack(known),
        tuple(features),
    )
    write_record(file, views)
    return len(depths)


def opened(part: Part, device: str = "cpu") -> SavedResult:
    """Load the result of a part. Raises InputError if it cannot be joined with others."""
    result = load_result(part.folder, device)
    if not len(result.views.keyframe_id):
        raise InputError(f"{part.folder} has no keyframes; nothing can be joined to it.")
    if not result.views.has_images:
        raise InputError(
            f"{part.folder} was written without the images of its keyframes, by which places are "
            "recognised; run again with --keyframe-images."
        )
    return result


def image_of(result: SavedResult, number: int, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    """The image of a keyframe, by its index, resampled to another camera of the same pose."""
    path = image_path(result.folder, int(result.views.keyframe_id[number]))
    return resampled(read_image(path), result.camera, camera)


def resampled(
    image: UInt8[np.ndarray, "h w 3"], own: Camera, other: Camera
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Resample an image of a pinhole camera to another of the same pose; black outside."""
    if own == other:
        return image
    sx, sy = other.fx / own.fx, other.fy / own.fy
    to_other = np.array([[sx, 0, other.cx - sx * own.cx], [0, sy, other.cy - sy * own.cy]])
    size = (other.width, other.height)
    return cv2.warpAffine(image, to_other, size, flags=cv2.INTER_LINEAR).astype(np.uint8)


def _on_grid(
    result: SavedResult, T_cw: torch.Tensor, grid: SampleGrid
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth and information of the cells, from the depth rendered from the map."""
    from geogs.bundle.device_choice import grid_fields

    long_edge = max(result.depth_camera.width, result.depth_camera.height)
    camera = grid.camera.with_long_edge(long_edge)
    maps = result.renderer.surface(T_cw, camera)
    scale = grid.pixels.new_tensor(
        [camera.width / grid.camera.width, camera.height / grid.camera.height]
    )
    column, row = ((grid.pixels + 0.5) * scale - 0.5).round().long().unbind(-1)
    depth = maps.depth.cpu()[row, column]
    is_known = (depth > 0) & (maps.weight.cpu()[row, column] > 0)
    inverse = torch.where(is_known, 1 / torch.where(is_known, depth, 1.0), 0.0).float()
    information = torch.where(is_known, 1 / (DEVIATION * inverse).square(), 0.0).float()
    if not bool(is_known.any()):
        return np.ones(grid.size, np.float32), np.zeros(grid.size, np.float32)
    return grid_fields(grid).fill(inverse, information).numpy(), information.numpy()
