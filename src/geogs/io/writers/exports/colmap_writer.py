"""COLMAP's sparse model, as text or binary: https://colmap.github.io/format.html.

Its first pixel has its centre at (0.5, 0.5); poses are world to camera in OpenCV axes, quaternions
in the order w, x, y, z. Cameras, images and points are numbered from 1.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from geogs.geometry.camera import Camera
from geogs.geometry.lie import matrix_to_quaternion
from geogs.guard.atomic import atomic_file, write_text
from geogs.io.writers.exports.exported import ExportedImage, SeenPoints

_PINHOLE = 1
_UNKNOWN_ERROR = -1.0
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])


@dataclass(frozen=True)
class _Model:
    """Content of the three files."""

    camera: Camera
    names: list[str]
    """Names of the images."""
    poses: list[list[float]]
    """Quaternion w, x, y, z and translation of each image."""
    points: SeenPoints
    seen: list[np.ndarray]
    """Observations of each image."""
    tracks: list[np.ndarray]
    """Observations of each point: number of the image, and index in that image's list."""

    @property
    def parameters(self) -> list[float]:
        """Focal lengths and principal point, in COLMAP's pixels."""
        c = self.camera
        return [c.fx, c.fy, c.cx + 0.5, c.cy + 0.5]


def write_colmap_model(
    folder: Path,
    camera: Camera,
    images: Sequence[ExportedImage],
    points: SeenPoints,
    as_text: bool = False,
) -> None:
    """Write cameras, images and points3D; every image has the same pinhole camera.

    Raises:
        OutputError: a file cannot be written.
    """
    names = [image.name for image in images]
    poses = [_pose(image.T_cw) for image in images]
    seen = [_observations(points, number) for number in range(len(images))]
    model = _Model(camera, names, poses, points, seen, _tracks(points))
    write = _write_text if as_text else _write_binary
    write(folder, model)


def _pose(T_cw: Float64[np.ndarray, "4 4"]) -> list[float]:
    """Quaternion w, x, y, z and translation."""
    quaternion = matrix_to_quaternion(torch.from_numpy(T_cw[:3, :3])).numpy()
    return [*map(float, quaternion), *map(float, T_cw[:3, 3])]


def _observations(points: SeenPoints, image: int) -> np.ndarray:
    """Observations of an image: pixel and number of the point."""
    own = points.seen_image == image
    table = np.empty(int(own.sum()), _OBSERVATION)
    table["x"], table["y"] = (points.seen_at[own] + 0.5).T
    table["point"] = points.seen_point[own] + 1
    return table


def _tracks(points: SeenPoints) -> list[np.ndarray]:
    """Observations of each point: number of the image, and index in that image's list."""
    place = np.zeros(len(points.seen_image), np.int64)
    order = np.argsort(points.seen_image, kind="stable")
    counts = np.bincount(points.seen_image)
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    place[order] = np.arange(len(order)) - starts
    rows = np.stack([points.seen_image + 1, place], -1)
    ends = np.cumsum(np.bincount(points.seen_point, minlength=len(points.positions)))
    return np.split(rows, ends[:-1]) if len(ends) else []


def _write_text(folder: Path, model: _Model) -> None:
    size = f"{model.camera.width} {model.camera.height}"
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    lines.append(f"1 PINHOLE {size} " + _numbers(model.parameters))
    write_text(folder / "cameras.txt", "\n".join([*lines, ""]))
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then X, Y, POINT3D_ID"]
    images = zip(model.names, model.poses, model.seen, strict=True)
    for number, (name, pose, seen) in enumerate(images, start=1):
        lines.append(f"{number} {_numbers(pose)} 1 {name}")
        lines.append(" ".join(f"{x:.4f} {y:.4f} {point}" for x, y, point in seen.tolist()))
    write_text(folder / "images.txt", "\n".join([*lines, ""]))
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for number, track in enumerate(model.tracks):
        colour = " ".join(map(str, model.points.colours[number].tolist()))
        position = _numbers(model.points.positions[number].tolist())
        views = " ".join(map(str, track.ravel().tolist()))
        lines.append(f"{number + 1} {position} {colour} {_UNKNOWN_ERROR:g} {views}")
    write_text(folder / "points3D.txt", "\n".join([*lines, ""]))


def _write_binary(folder: Path, model: _Model) -> None:
    camera = model.camera
    points = model.points
    with atomic_file(folder / "cameras.bin") as stream:
        stream.write(struct.pack("<QIiQQ", 1, 1, _PINHOLE, camera.width, camera.height))
        stream.write(struct.pack("<4d", *model.parameters))
    with atomic_file(folder / "images.bin") as stream:
        stream.write(struct.pack("<Q", len(model.names)))
        images = zip(model.names, model.poses, model.seen, strict=True)
        for number, (name, pose, seen) in enumerate(images, start=1):
            stream.write(struct.pack("<I7dI", number, *pose, 1))
            stream.write(name.encode() + b"\0" + struct.pack("<Q", len(seen)))
            stream.write(seen.tobytes())
    with atomic_file(folder / "points3D.bin") as stream:
        stream.write(struct.pack("<Q", len(model.tracks)))
        for number, track in enumerate(model.tracks):
            position = points.positions[number].tolist()
            colour = points.colours[number].tolist()
            stream.write(struct.pack("<Q3d3Bd", number + 1, *position, *colour, _UNKNOWN_ERROR))
            stream.write(struct.pack("<Q", len(track)) + track.astype("<u4").tobytes())


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
