"""Depth and normal maps: 16-bit PNG for programs that read images, NPZ in full precision."""

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from geogs.geometry.camera import Camera
from geogs.guard.atomic import atomic_file, write_text
from geogs.io.writers.intrinsics_file import pinhole
from geogs.io.writers.keyframe_folder import write_picture

STEPS = 65535
"""Largest value of a 16-bit image."""


def depth_unit(farthest: float) -> float:
    """Map units per step of a depth image: the least power of ten that holds the farthest depth."""
    return float(10.0 ** np.ceil(np.log10(max(farthest, 1e-30) / STEPS)))


def write_depth_png(path: Path, depth: Float[np.ndarray, "h w"], unit: float) -> None:
    """Write depth in steps of ``unit``, rounded; 0 where it is unknown or beyond the last step."""
    steps = np.round(np.where(np.isfinite(depth), depth, 0.0) / unit)
    write_picture(path, np.where((steps > 0) & (steps <= STEPS), steps, 0).astype(np.uint16))


def write_normal_png(path: Path, normal: Float[np.ndarray, "h w 3"]) -> None:
    """Write normals as RGB: 0 to 65535 for -1 to 1; black where there is none."""
    known = np.linalg.norm(normal, axis=-1, keepdims=True) > 0.5
    steps = np.round((0.5 + 0.5 * normal.clip(-1, 1)) * STEPS)
    rgb = np.where(known, steps, 0).astype(np.uint16)
    write_picture(path, np.ascontiguousarray(rgb[..., ::-1]))


def write_npz(path: Path, name: str, values: Float32[np.ndarray, "..."]) -> None:
    """Write one array, compressed."""
    with atomic_file(path) as stream:
        np.savez_compressed(stream, **{name: values})  # type: ignore[arg-type]  # a name, no option


def write_description(path: Path, camera: Camera, meaning: dict[str, object]) -> None:
    """Write ``description.json``: the camera of the maps, and the meaning of their numbers."""
    document = {**pinhole(camera), "first_pixel_centre": [0, 0], **meaning}
    write_text(path, json.dumps(document, indent=2) + "\n")
