"""Results of parts of a painted box seen from inside, each in a world of its own, without a run."""

import json
from pathlib import Path

import cv2
import numpy as np
import torch

from geogs.application.results.write import write_config
from geogs.config import Config
from geogs.geometry.camera import Camera
from geogs.geometry.lie import sim3_exp, sim3_scale
from geogs.io.writers.keyframe_folder import image_path, write_image
from geogs.io.writers.map_file import MapViews, save_map_with_views
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.types import MapSnapshot, Trajectory
from geogs_fleet.join.joined_disks import transformed

CAMERA = Camera(160.0, 160.0, 127.5, 95.5, 256, 192)
DEPTH_CAMERA = CAMERA.with_long_edge(128)
HALF = np.array([2.0, 1.5, 1.2])
STEP = 0.07
"""Between disks."""
FRAMES = 3
"""For each keyframe, which is the middle one."""


def gauge(seed: int) -> torch.Tensor:
    """Sim(3) from the box to the world of a part; the first keeps the box's."""
    if seed == 0:
        return torch.eye(4, dtype=torch.float64)
    xi = np.random.default_rng(seed).normal(0, 0.5, 7)
    return sim3_exp(torch.from_numpy(xi))


def pose(s: float) -> np.ndarray:
    """Camera to box at a place of the walk: along y, looking at the wall at +x, turning a bit."""
    turn = 0.25 * np.sin(2 * s)
    ahead = np.array([np.cos(turn), np.sin(turn), 0.1 * np.cos(3 * s)])
    ahead /= np.linalg.norm(ahead)
    right = np.cross([0, 0, -1.0], ahead)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], -1)
    T[:3, 3] = [-0.6 + 0.1 * np.sin(3 * s), s, 0.1 * np.sin(4 * s)]
    return T


def walls(seed: int) -> list[np.ndarray]:
    """Six paintings, one for each wall."""
    random, made = np.random.default_rng(seed), []
    for _ in range(6):
        picture = np.zeros((512, 512, 3), np.float32)
        for cells, height in ((8, 40), (32, 40), (96, 40)):
            coarse = random.uniform(-height, height, (cells, cells, 3)).astype(np.float32)
            picture += cv2.resize(coarse, (512, 512), interpolation=cv2.INTER_CUBIC)
        made.append((picture + 128).clip(0, 255).astype(np.uint8))
    return made


def seen(T_wc: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth, wall and place on it (in [0, 1]^2) of every pixel."""
    d = camera.rays(torch.float64).numpy() @ T_wc[:3, :3].T
    t = (np.sign(d) * HALF - T_wc[:3, 3]) / np.where(np.abs(d) < 1e-12, 1e-12, d)
    axis = t.argmin(-1)
    depth = t.min(-1)
    hit = (T_wc[:3, 3] + depth[..., None] * d) / HALF
    sign = np.take_along_axis(np.sign(d), axis[..., None], -1)[..., 0]
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    place = (np.take_along_axis(hit, others, -1) + 1) / 2
    return depth, 2 * axis + (sign > 0), place


def image(T_wc: np.ndarray, paint: list[np.ndarray], camera: Camera = CAMERA) -> np.ndarray:
    """Image that the camera takes."""
    _, wall, place = seen(T_wc, camera)
    shown = np.zeros((camera.height, camera.width, 3), np.uint8)
    for n, picture in enumerate(paint):
        u, v = (511 * place).astype(np.float32).transpose(2, 0, 1)
        shown[wall == n] = cv2.remap(picture, u, v, cv2.INTER_LINEAR)[wall == n]
    return shown


def box_disks(T_wc: list[np.ndarray]) -> MapSnapshot:
    """Disks on the walls that some cameras see, in the box's frame, facing inwards."""
    position, quaternion = [], []
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        for sign in (-1.0, 1.0):
            lines = [np.arange(-HALF[a] + STEP / 2, HALF[a], STEP) for a in others]
            grid = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 2)
            points = np.zeros((len(grid), 3))
            points[:, others], points[:, axis] = grid, sign * HALF[axis]
            position.append(points)
            # Turns z to the inward normal.
            normal = np.zeros(3)
            normal[axis] = -sign
            q = np.array([1 + normal[2], -normal[1], normal[0], 0.0])
            q = q / np.linalg.norm(q) if normal[2] > -0.5 else np.array([0.0, 1.0, 0.0, 0.0])
            quaternion.append(np.tile(q, (len(grid), 1)))
    x, q = np.concatenate(position), np.concatenate(quaternion)
    keep = np.zeros(len(x), bool)
    for T in T_wc:
        y = (x - T[:3, 3]) @ T[:3, :3]
        z = np.maximum(y[:, 2], 1e-9)
        u, v = CAMERA.fx * y[:, 0] / z + CAMERA.cx, CAMERA.fy * y[:, 1] / z + CAMERA.cy
        keep |= (y[:, 2] > 0) & (u > -9) & (u < CAMERA.width + 9) & (v > -9) & (v < 201)
    n = int(keep.sum())
    return MapSnapshot(
        torch.from_numpy(x[keep]).float(), torch.from_numpy(q[keep]).float(),
        torch.full((n, 2), 0.7 * STEP), torch.full((n,), 0.95),
    )  # fmt: skip


def make_part(folder: Path, places: np.ndarray, number: int, paint: int = 0) -> Path:
    """A result whose keyframes are at some places of the walk, in the world ``gauge(number)``."""
    S, pictures = gauge(number), walls(paint)
    frames = true_frames(places)
    true = frames[1::FRAMES]
    T_wc = S.numpy() @ frames
    T_wc[:, :3, :3] /= float(sim3_scale(S))
    times = np.arange(len(frames)) / 30
    T_cw = np.linalg.inv(T_wc[1::FRAMES])
    disks = box_disks(list(true))
    disks = transformed(disks, S.expand(len(disks), 4, 4))
    ids = np.arange(len(places))
    views = MapViews(
        CAMERA, DEPTH_CAMERA, 0.5, 0.02, 0.04, np.zeros(3), 1.0, disks, ids, times[1::FRAMES], T_cw,
        np.zeros(len(ids), bool), True,
    )  # fmt: skip
    save_map_with_views(folder / "map.safetensors", views, {"source": folder.name})
    for id, T in zip(ids, true, strict=True):
        write_image(image_path(folder, int(id)), image(T, pictures))
    write_tum_trajectory(folder / "trajectory.tum", Trajectory(times, T_wc, times > -1))
    write_config(folder / "config.yaml", Config())
    verdict = {"is_reliable": True, "sentence": "Fine."}
    summary = {"source": folder.name, "fingerprint": folder.name, "verdict": verdict}
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def true_frames(places: np.ndarray) -> np.ndarray:
    """Camera to box of all frames of a part."""
    step = float(places[1] - places[0]) / FRAMES
    return np.array([pose(s + k * step) for s in places for k in (-1, 0, 1)])
