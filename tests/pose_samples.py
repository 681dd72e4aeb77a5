"""Recordings with poses, as apps write them, for the tests of what is read."""

import json
import math
import zipfile
from pathlib import Path

import cv2
import numpy as np
import torch

from geogs.geometry.lie import matrix_to_quaternion
from io_samples import gradient_image, write_image, write_video

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def walked(count: int) -> list[np.ndarray]:
    """Camera to world in OpenCV axes: some steps, with turns."""
    poses = []
    for k in range(count):
        T = np.eye(4)
        c, s = math.cos(0.1 * k), math.sin(0.1 * k)
        T[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        T[:3, 3] = 0.1 * k, 0.02 * k, 0.3
        poses.append(T)
    return poses


def quaternion(T_wc: np.ndarray) -> np.ndarray:
    """qx, qy, qz, qw of a pose."""
    return matrix_to_quaternion(torch.from_numpy(T_wc[:3, :3])).numpy()[[1, 2, 3, 0]]


def write_depth(path: Path, units: np.ndarray) -> None:
    """A picture of depth, or of confidence."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), units)


def write_stray(folder: Path, poses: list[np.ndarray], rotation: int = 0) -> None:
    """A recording of Stray Scanner, with depth of its frame 1."""
    images = [gradient_image(k) for k in range(len(poses))]
    write_video(folder / "rgb.mp4", images, rotation=rotation)
    depth = np.full((12, 16), 1500, np.uint16)
    confidence = np.full((12, 16), 2, np.uint8)
    confidence[:, :8], confidence[:, 8:12] = 0, 1
    write_depth(folder / "depth/000001.png", depth)
    write_depth(folder / "confidence/000001.png", confidence)
    (folder / "camera_matrix.csv").write_text("50.0,0.0,31.5\n0.0,50.0,23.5\n0.0,0.0,1.0\n")
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for k, T in enumerate(poses):
        numbers = [k / 60, *T[:3, 3], *quaternion(T)]
        lines.append(
            ", ".join([repr(float(numbers[0])), f"{k:06d}", *map(repr, map(float, numbers[1:]))])
        )
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")


def write_record3d(folder: Path, poses: list[np.ndarray]) -> Path:
    """What is in an archive of Record3D, but for depth; returns the archive of it."""
    for k in range(len(poses)):
        write_image(folder / f"rgbd/{k}.jpg", gradient_image(k))
    rows = [[*quaternion(T @ OPENGL), *T[:3, 3]] for T in poses]
    facts = {
        "w": 64, "h": 48, "fps": 60, "K": [50, 0, 0, 0, 51, 0, 31, 23, 1], "dw": 16, "dh": 12,
        "poses": [[float(x) for x in row] for row in rows],
    }  # fmt: skip
    (folder / "metadata").write_text(json.dumps(facts))
    return archived(folder)


def write_record3d_export(folder: Path, poses: list[np.ndarray]) -> None:
    """What Record3D exports as pictures, in its ``EXR_RGBD``; of the depth the name alone."""
    inner = folder / "EXR_RGBD"
    for k in range(len(poses)):
        write_image(inner / f"rgb/{k}.jpg", gradient_image(k))
        (inner / "depth").mkdir(exist_ok=True)
        (inner / f"depth/{k}.exr").write_bytes(b"")
    rows = [[*quaternion(T @ OPENGL), *T[:3, 3]] for T in poses]
    facts = {
        "w": 64, "h": 48, "fps": 60, "K": [50, 0, 0, 0, 51, 0, 31, 23, 1],
        "frameTimestamps": [0.02 * k for k in range(len(poses))],
        "poses": [[float(x) for x in row] for row in rows],
    }  # fmt: skip
    (inner / "metadata.json").write_text(json.dumps(facts))


def archived(folder: Path) -> Path:
    """The archive of a folder of Record3D."""
    path = folder.with_suffix(".r3d")
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, file.relative_to(folder))
    return path


def write_polycam(folder: Path, poses: list[np.ndarray], step: int = 250_000) -> None:
    """An export of Polycam's raw data, so many microseconds from image to image."""
    for k, T in enumerate(poses):
        name = 1442008525605 + step * k
        write_image(folder / f"keyframes/images/{name}.jpg", gradient_image(k))
        A = T @ OPENGL
        entry = {f"t_{i}{j}": float(A[i, j]) for i in range(3) for j in range(4)}
        entry |= {"fx": 50, "fy": 51, "cx": 31, "cy": 23, "width": 64, "height": 48}
        path = folder / f"keyframes/cameras/{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(entry))


def write_transforms(folder: Path, poses: list[np.ndarray]) -> None:
    """Images with a ``transforms.json`` of nerfstudio."""
    frames = []
    for k, T in enumerate(poses):
        write_image(folder / f"images/{k:03d}.png", gradient_image(k))
        frames.append(
            {"file_path": f"images/{k:03d}.png", "transform_matrix": (T @ OPENGL).tolist()}
        )
    camera = {"fl_x": 50, "fl_y": 50, "cx": 32, "cy": 24, "w": 64, "h": 48}
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))


def write_tum_poses(path: Path, poses: list[np.ndarray], step: float) -> None:
    """Rows of TUM, one every ``step`` seconds."""
    rows = [[k * step, *T[:3, 3], *quaternion(T)] for k, T in enumerate(poses)]
    path.write_text("".join(" ".join(f"{x:.9f}" for x in row) + "\n" for row in rows))
