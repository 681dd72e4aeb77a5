"""COLMAP's sparse model, as text or binary: https://colmap.github.io/format.html.

Its first pixel has its centre at (0.5, 0.5); poses are world to camera in OpenCV axes, quaternions
in the order w, x, y, z. Cameras, images and points are numbered from 1.
"""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from geogs.geometry.camera import Camera
from geogs.geometry.lie import matrix_to_quaternion
from geogs.io.writers.atomic import atomic_file, write_text
from geogs.io.writers.exports.exported import ExportedImage, SeenPoints

_PINHOLE = 1
_UNKNOWN_ERROR = -1.0
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])


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
    poses = [_pose(image.T_cw) for image in images]
    seen = [_observations(points, number) for number in range(len(images))]
    tracks = _tracks(points)
    if as_text:
        _write_text(folder, camera, images, poses, points, seen, tracks)
    else:
        _write_binary(folder, camera, images, poses, points, seen, tracks)


def _pose(T_cw: Float64[np.ndarray, "4 4"]) -> list[float]:
    """Quaternion w, x, y, z and translation."""
    quaternion = matrix_to_quaternion(torch.from_numpy(T_cw[:3, :3])).numpy()
    return [*map(float, quaternion), *map(float, T_cw[:3, 3])]


def _parameters(camera: Camera) -> list[float]:
    return [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]


def _observations(points: SeenPoints, image: int) -> np.ndarray:
    """Where an image sees which point."""
    own = points.seen_image == image
    table = np.empty(int(own.sum()), _OBSERVATION)
    table["x"], table["y"] = (points.seen_at[own] + 0.5).T
    table["point"] = points.seen_point[own] + 1
    return table


def _tracks(points: SeenPoints) -> list[np.ndarray]:
    """Numbers of the images that see each point, and its place in each one's list."""
    place = np.zeros(len(points.seen_image), np.int64)
    order = np.argsort(points.seen_image, kind="stable")
    counts = np.bincount(points.seen_image)
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    place[order] = np.arange(len(order)) - starts
    rows = np.stack([points.seen_image + 1, place], -1)
    ends = np.cumsum(np.bincount(points.seen_point, minlength=len(points.positions)))
    return np.split(rows, ends[:-1]) if len(ends) else []


def _write_text(
    folder: Path,
    camera: Camera,
    images: Sequence[ExportedImage],
    poses: list[list[float]],
    points: SeenPoints,
    seen: list[np.ndarray],
    tracks: list[np.ndarray],
) -> None:
    size = f"{camera.width} {camera.height}"
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    lines.append(f"1 PINHOLE {size} " + _numbers(_parameters(camera)))
    write_text(folder / "cameras.txt", "\n".join([*lines, ""]))
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then X, Y, POINT3D_ID"]
    for number, (image, pose) in enumerate(zip(images, poses, strict=True)):
        lines.append(f"{number + 1} {_numbers(pose)} 1 {image.name}")
        lines.append(" ".join(f"{x:.4f} {y:.4f} {point}" for x, y, point in seen[number].tolist()))
    write_text(folder / "images.txt", "\n".join([*lines, ""]))
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for number, track in enumerate(tracks):
        colour = " ".join(map(str, points.colours[number].tolist()))
        place = _numbers(points.positions[number].tolist())
        views = " ".join(map(str, track.ravel().tolist()))
        lines.append(f"{number + 1} {place} {colour} {_UNKNOWN_ERROR:g} {views}")
    write_text(folder / "points3D.txt", "\n".join([*lines, ""]))


def _write_binary(
    folder: Path,
    camera: Camera,
    images: Sequence[ExportedImage],
    poses: list[list[float]],
    points: SeenPoints,
    seen: list[np.ndarray],
    tracks: list[np.ndarray],
) -> None:
    with atomic_file(folder / "cameras.bin") as stream:
        stream.write(struct.pack("<QIiQQ", 1, 1, _PINHOLE, camera.width, camera.height))
        stream.write(struct.pack("<4d", *_parameters(camera)))
    with atomic_file(folder / "images.bin") as stream:
        stream.write(struct.pack("<Q", len(images)))
        for number, (image, pose) in enumerate(zip(images, poses, strict=True)):
            stream.write(struct.pack("<I7dI", number + 1, *pose, 1))
            stream.write(image.name.encode() + b"\0" + struct.pack("<Q", len(seen[number])))
            stream.write(seen[number].tobytes())
    with atomic_file(folder / "points3D.bin") as stream:
        stream.write(struct.pack("<Q", len(tracks)))
        for number, track in enumerate(tracks):
            place, colour = points.positions[number].tolist(), points.colours[number].tolist()
            stream.write(struct.pack("<Q3d3Bd", number + 1, *place, *colour, _UNKNOWN_ERROR))
            stream.write(struct.pack("<Q", len(track)) + track.astype("<u4").tobytes())


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
