"""A small result in a folder, made of disks on two known planes, without a run."""

from pathlib import Path

import cv2
import numpy as np
import torch

from geogs.application.results.write import write_config
from geogs.config import ReconstructConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.io.writers.keyframe_folder import image_path, mask_path, write_image, write_mask
from geogs.io.writers.map_file import MapViews, save_map_with_views
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.types import MapSnapshot, Trajectory

CAMERA = Camera(70.0, 72.0, 40.2, 28.7, 80, 60)
DEPTH_CAMERA = CAMERA.with_long_edge(40)
ORIGIN, UNIT = np.array([10.0, -5.0, 3.0]), 2.5
WALL, BLOCK = 3.0, 2.0
"""Map units from the first camera: a wall, and before it a square block's front."""
IDS = [0, 2, 3, 7, 9]
MASKED = 2
"""Which of the keyframes has a mask: its left half."""


def disks_of_the_scene() -> MapSnapshot:
    """Disks in the map's own frame, facing the first camera."""
    parts = []
    for z, half, step in ((WALL, 3.2, 0.08), (BLOCK, 0.35, 0.05)):
        line = torch.arange(-half, half + step / 2, step)
        y, x = torch.meshgrid(line, line, indexing="ij")
        centres = torch.stack([x, y, torch.full_like(x, z)], -1).reshape(-1, 3)
        parts.append((centres, torch.full((len(centres), 2), step)))
    position, scale = (torch.cat(some) for some in zip(*parts, strict=True))
    quaternion = torch.tensor([0.0, 1.0, 0.0, 0.0]).expand(len(position), 4)
    opacity = torch.full((len(position),), 0.95)
    return MapSnapshot(position, quaternion.contiguous(), scale, opacity)


def depth_of_the_scene(T_cw: np.ndarray, camera: Camera) -> np.ndarray:
    """Depth of wall and block as a camera with a pose in the map's frame sees them, map units."""
    T_wc = np.linalg.inv(T_cw)
    rays = camera.rays(torch.float64).numpy() @ T_wc[:3, :3].T
    near, far = ((z - T_wc[2, 3]) / rays[..., 2] for z in (BLOCK, WALL))
    hit = T_wc[:3, 3] + near[..., None] * rays
    on_block = (np.abs(hit[..., :2]) <= 0.35).all(-1)
    return np.where(on_block, near, far)


def poses_of_the_scene() -> np.ndarray:
    """World to camera of the keyframes, in the map's frame: a small walk to the right."""
    steps = [[-0.12 * i, 0.02 * i, 0.0, 0.0, 0.03 * i, 0.01 * i] for i in range(len(IDS))]
    return se3_exp(torch.tensor(steps, dtype=torch.float64)).numpy()


def make_result(folder: Path, with_images: bool = True) -> Path:
    """Write a result whose world is the map's frame times ``UNIT``, moved to ``ORIGIN``."""
    disks, own = disks_of_the_scene(), poses_of_the_scene()
    T_cw = own.copy()
    T_cw[:, :3, 3] = UNIT * own[:, :3, 3] - own[:, :3, :3] @ ORIGIN
    times = np.array(IDS) / 30
    views = MapViews(
        CAMERA, DEPTH_CAMERA, 0.5, 0.02, 0.04, ORIGIN, UNIT, disks, np.array(IDS), times, T_cw,
        np.arange(len(IDS)) == MASKED, with_images,
    )  # fmt: skip
    save_map_with_views(folder / "map.safetensors", views, {"source": "planes"})
    random = np.random.default_rng(0)
    for id in IDS:
        coarse = random.integers(30, 220, (6, 8, 3), dtype=np.uint8)
        image = cv2.resize(coarse, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_CUBIC)
        write_image(image_path(folder, id), image)
    mask = np.zeros((DEPTH_CAMERA.height, DEPTH_CAMERA.width), bool)
    mask[:, :20] = True
    write_mask(mask_path(folder, IDS[MASKED]), mask)
    trajectory = Trajectory(times, np.linalg.inv(T_cw), np.ones(len(times), bool))
    write_tum_trajectory(folder / "trajectory.tum", trajectory)
    write_config(folder / "config.yaml", ReconstructConfig())
    return folder
