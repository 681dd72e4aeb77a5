"""Beside the disks in ``map.safetensors``: from where and how the map was seen."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from geogs.documents import UNUSABLE
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.writers.intrinsics import camera_of
from geogs.io.writers.native import MapFile, load_map_file, save_map
from geogs.types import MapSnapshot


@dataclass(frozen=True)
class MapViews:
    """The keyframes that a map's depth maps are made for, and all that those depend on."""

    camera: Camera
    """Of the keyframes' images."""
    render_camera: Camera
    """Of the depth maps."""
    min_alpha: float
    """Opacity above which the map hides what lies behind."""
    max_spread: float
    """Relative difference of mean and median depth up to which a ray meets one surface."""
    origin: Float64[np.ndarray, "3"]
    """World coordinates of the origin of the map's own frame."""
    unit: float
    """Length of a unit of the map's own frame in the world."""
    disks: MapSnapshot
    """In the map's own frame, where they are rendered."""
    keyframe_id: Int64[np.ndarray, "k"]
    timestamp: Float64[np.ndarray, "k"]
    """Seconds."""
    T_cw: Float64[np.ndarray, "k 4 4"]
    """World to camera."""
    has_mask: Bool[np.ndarray, "k"]
    """Whether a keyframe has a mask, in ``keyframes/``."""
    has_images: bool
    """Whether the images are kept, in ``keyframes/``."""


def save_map_with_views(
    path: str | Path, disks: MapSnapshot, views: MapViews, metadata: Mapping[str, Any] = {}
) -> None:
    """Write the disks in the world, and the views beside them.

    A map in a frame of its own has its positions and scales there as well: those of the world have
    lost digits.
    """
    tensors: dict[str, Tensor] = {
        "keyframe_id": torch.from_numpy(views.keyframe_id),
        "keyframe_time": torch.from_numpy(views.timestamp),
        "keyframe_T_cw": torch.from_numpy(views.T_cw),
        "keyframe_has_mask": torch.from_numpy(views.has_mask),
    }
    if views.origin.any() or views.unit != 1.0:
        tensors |= {"map_position": views.disks.position, "map_scale": views.disks.scale}
    description = {
        "camera": asdict(views.camera),
        "render_camera": asdict(views.render_camera),
        "min_alpha": views.min_alpha,
        "max_spread": views.max_spread,
        "origin": views.origin.tolist(),
        "unit": views.unit,
        "has_images": views.has_images,
    }
    save_map(path, disks, {**metadata, "views": description}, tensors)


def load_map_views(
    path: str | Path, device: torch.device | str = "cpu"
) -> tuple[MapSnapshot, MapViews]:
    """Read the disks in the world, and the views beside them.

    Raises:
        InputError: the map cannot be read, or was written before maps had views.
    """
    file = load_map_file(path, device)
    if "views" not in file.metadata:
        raise InputError(
            f"{path} has no camera and no keyframes beside the disks, as an older geogs wrote it; "
            "run again to use the result further."
        )
    try:
        return file.disks, _views(file)
    except UNUSABLE as error:
        raise InputError(f"{path} does not say how the map was seen; was it changed?") from error


def _views(file: MapFile) -> MapViews:
    said, tensors, disks = file.metadata["views"], file.tensors, file.disks
    position = tensors.get("map_position", disks.position).to(disks.position)
    scale = tensors.get("map_scale", disks.scale).to(disks.scale)
    if position.shape != disks.position.shape or scale.shape != disks.scale.shape:
        raise ValueError("its disks differ in number")
    names = ("id", "time", "T_cw", "has_mask")
    ids, times, T_cw, masked = (tensors[f"keyframe_{name}"] for name in names)
    if not times.shape == masked.shape == ids.shape or T_cw.shape != (*ids.shape, 4, 4):
        raise ValueError("its keyframes differ in number")
    return MapViews(
        camera=camera_of(said["camera"]),
        render_camera=camera_of(said["render_camera"]),
        min_alpha=float(said["min_alpha"]),
        max_spread=float(said["max_spread"]),
        origin=np.array(said["origin"], np.float64).reshape(3),
        unit=float(said["unit"]),
        disks=MapSnapshot(position, disks.quaternion, scale, disks.opacity),
        keyframe_id=ids.long().numpy(),
        timestamp=times.double().numpy(),
        T_cw=T_cw.double().numpy(),
        has_mask=masked.bool().numpy(),
        has_images=bool(said["has_images"]),
    )
