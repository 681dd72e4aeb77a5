"""One small synthetic room, written in every layout of images with known poses."""

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geogs.geometry.camera import Camera
from io_samples import write_image

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
MODEL_NUMBERS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "OPENCV": 4, "FOV": 7}


@dataclass
class Room:
    """Images of a camera at known places, and points that some of them see."""

    camera: Camera
    images: list[np.ndarray]
    T_cw: np.ndarray
    points: np.ndarray
    seen_by: list[list[int]]
    """Images that see each point."""

    @property
    def T_wc(self) -> np.ndarray:
        return np.linalg.inv(self.T_cw)

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy with pixel centres at one half."""
        c = self.camera
        return c.fx, c.fy, c.cx + 0.5, c.cy + 0.5


def render_room(frames: int, step: int, width: int, height: int) -> Room:
    """A walk through the room."""
    from handheld_walk import handheld_trajectory
    from lit_rooms import lit_room

    camera = Camera(0.7 * width, 0.71 * width, width / 2 - 3.25, height / 2 + 1.5, width, height)
    raycaster = lit_room(3)
    T_wc = handheld_trajectory(raycaster.scene, 120, 3)[: frames * step : step]
    views = [raycaster.render(camera, T) for T in T_wc]
    points, seen_by = [], []
    K = camera.matrix().numpy()
    for i in range(frames - 1):
        u = np.array([width // 2 + 2 * i, height // 2, 1.0])
        ray = np.linalg.inv(K) @ u
        depth = views[i].depth[int(u[1]), int(u[0])]
        points.append(T_wc[i, :3, :3] @ (ray * depth) + T_wc[i, :3, 3])
        seen_by.append([i, i + 1])
    T_cw = np.linalg.inv(T_wc)
    return Room(camera, [view.image for view in views], T_cw, np.array(points), seen_by)


def write_room_images(room: Room, folder: Path, pattern: str, start: int = 0) -> list[str]:
    names = [pattern.format(i + start) for i in range(len(room.images))]
    for name, image in zip(names, room.images, strict=True):
        write_image(folder / name, image)
    return names


def quaternion_wxyz(R: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(R).as_quat()[[3, 0, 1, 2]]


def colmap_rows(room: Room, names: list[str]) -> list[tuple[int, np.ndarray, np.ndarray, str]]:
    """Identifier, quaternion, translation, name; not in the order of names."""
    rows = [
        (7 + 2 * i, quaternion_wxyz(T[:3, :3]), T[:3, 3], name)
        for i, (T, name) in enumerate(zip(room.T_cw, names, strict=True))
    ]
    return rows[::-1]


def write_colmap_text(room: Room, folder: Path, names, model="PINHOLE", parameters=None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    c, parameters = room.camera, parameters or room.pinhole
    words = " ".join(repr(float(p)) for p in parameters)
    (folder / "cameras.txt").write_text(f"# cameras\n1 {model} {c.width} {c.height} {words}\n")
    lines = ["# images"]
    for number, q, t, name in colmap_rows(room, names):
        pose = " ".join(repr(float(x)) for x in (*q, *t))
        # Every other image has keypoints, the others an empty row.
        lines += [f"{number} {pose} 1 {name}", "3.5 4.5 -1 8.0 9.0 2" if number % 4 == 3 else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = ["# points"]
    for k, (point, images) in enumerate(zip(room.points, room.seen_by, strict=True)):
        track = " ".join(f"{7 + 2 * i} 0" for i in images)
        position = " ".join(repr(float(x)) for x in point)
        lines.append(f"{k + 1} {position} 10 20 30 0.5 {track}")
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
    return folder


def write_colmap_binary(room: Room, folder: Path, names, model="PINHOLE", parameters=None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    c, parameters = room.camera, parameters or room.pinhole
    data = struct.pack("<QIiQQ", 1, 1, MODEL_NUMBERS[model], c.width, c.height)
    (folder / "cameras.bin").write_bytes(data + struct.pack(f"<{len(parameters)}d", *parameters))
    data = struct.pack("<Q", len(names))
    for number, q, t, name in colmap_rows(room, names):
        data += struct.pack("<I7dI", number, *q, *t, 1) + name.encode() + b"\0"
        keypoints = [(3.5, 4.5, -1), (8.0, 9.0, 2)] if number % 4 == 3 else []
        data += struct.pack("<Q", len(keypoints))
        for keypoint in keypoints:
            data += struct.pack("<ddq", *keypoint)
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(room.points))
    for k, (point, images) in enumerate(zip(room.points, room.seen_by, strict=True)):
        data += struct.pack("<Q3d3Bd", k + 1, *point, 10, 20, 30, 0.5)
        data += struct.pack("<Q", len(images))
        for i in images:
            data += struct.pack("<II", 7 + 2 * i, 0)
    (folder / "points3D.bin").write_bytes(data)
    return folder


def nerfstudio_document(room: Room, names: list[str]) -> dict:
    fx, fy, cx, cy = room.pinhole
    return {
        "camera_model": "OPENCV",
        "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": room.camera.width,
        "h": room.camera.height, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
        "frames": [
            {"file_path": name, "transform_matrix": (T @ OPENGL).tolist()}
            for name, T in zip(names, room.T_wc, strict=True)
        ][::-1],
    }  # fmt: skip


def write_nerfstudio(room: Room, folder: Path) -> Path:
    names = write_room_images(room, folder, "images/frame_{:05d}.png", 1)
    (folder / "transforms.json").write_text(json.dumps(nerfstudio_document(room, names)))
    return folder


def write_dtu(room: Room, folder: Path) -> Path:
    write_room_images(room, folder, "image/{:06d}.png")
    fx, fy, cx, cy = room.pinhole
    K = np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    scale = np.diag([2.5, 2.5, 2.5, 1.0])
    scale[:3, 3] = [1, 2, 3]
    matrices = {}
    for i, T in enumerate(room.T_cw):
        # A projection matrix has no scale of its own, nor sign.
        matrices[f"world_mat_{i}"] = (K @ T) * (-3.0 if i % 2 else 1.0)
        matrices[f"scale_mat_{i}"] = scale
        mask = np.zeros_like(room.images[0])
        mask[40:, i:200] = 255
        write_image(folder / "mask" / f"{i:03d}.png", mask)
    np.savez(folder / "cameras.npz", **matrices)
    return folder


def write_replica(room: Room, folder: Path) -> Path:
    write_room_images(room, folder, "results/frame{:06d}.png")
    np.savetxt(folder / "traj.txt", room.T_wc.reshape(-1, 16), fmt="%.17g")
    c = room.camera
    entry = {"w": c.width, "h": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy}
    (folder / "cam_params.json").write_text(json.dumps({"camera": entry}))
    return folder


def write_calibration_text(room: Room, path: Path) -> None:
    c = room.camera
    path.write_text(" ".join(repr(x) for x in (c.fx, c.fy, c.cx, c.cy)))


def write_tum(room: Room, folder: Path) -> Path:
    """Images exactly at every other measured pose."""
    write_room_images(room, folder, "rgb/{:d}.png")
    n = len(room.images)
    rows = [f"{100 + 0.04 * i:.6f} rgb/{i}.png" for i in range(n)]
    (folder / "rgb.txt").write_text("# time file\n" + "\n".join(rows))
    lines = ["# t tx ty tz qx qy qz qw"]
    for i, T in enumerate(room.T_wc):
        q = Rotation.from_matrix(T[:3, :3]).as_quat()
        lines.append(" ".join(repr(float(x)) for x in (100 + 0.04 * i, *T[:3, 3], *q)))
    (folder / "groundtruth.txt").write_text("\n".join(lines))
    write_calibration_text(room, folder / "calib.txt")
    return folder


def write_seven_scenes(room: Room, folder: Path) -> Path:
    """The poses of a depth camera that stands 2.5 cm to the left of the colour camera."""
    write_room_images(room, folder, "frame-{:06d}.color.png")
    depth_from_colour = np.eye(4)
    depth_from_colour[0, 3] = 0.025
    for i, T in enumerate(room.T_cw):
        T_wc = np.linalg.inv(depth_from_colour @ T)
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", T_wc, fmt="%.17g")
    write_calibration_text(room, folder / "calib.txt")
    return folder


def write_scannet(room: Room, folder: Path) -> Path:
    write_room_images(room, folder, "color/{:d}.png")
    (folder / "pose").mkdir()
    (folder / "intrinsic").mkdir()
    for i, T in enumerate(room.T_wc):
        np.savetxt(folder / "pose" / f"{i}.txt", T, fmt="%.17g")
    K = np.eye(4)
    K[:3, :3] = room.camera.matrix().numpy()
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", K, fmt="%.17g")
    return folder
