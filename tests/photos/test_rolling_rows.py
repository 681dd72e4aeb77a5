"""Rows that were read one after the other are put where all would be seen at once."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geogs.geometry.umeyama import umeyama
from geogs_photos.incremental_mapping import adjust_free, placed_images
from geogs_photos.rolling_rows import with_rows_at_once

FRAMES, STEP, HEIGHT = 12, 0.2, 240


def pose(time: float) -> np.ndarray:
    """World to camera on an arc about what is seen."""
    T = np.eye(4)
    turn = [0.2 * np.sin(2.0 * time), 0.5 * np.sin(time), 0.0]
    T[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    T[:3, 3] = 0.5 * np.sin(1.3 * time), 0.1 * np.sin(time), 4.0
    return T


def seen(points: np.ndarray, time: float, readout: float) -> np.ndarray:
    """Pixels, each at the time of its row."""
    pixels = np.full((len(points), 2), HEIGHT / 2)
    for _ in range(8):
        times = time + readout * (pixels[:, 1] / HEIGHT - 0.5)
        local = np.stack(
            [T[:3, :3] @ p + T[:3, 3] for p, T in zip(points, map(pose, times), strict=True)]
        )
        pixels = 250 * local[:, :2] / local[:, 2:] + [160, 120]
    return pixels


@pytest.mark.parametrize(("readout", "better"), [(0.02, 4.0), (0.0, 0.0)])
def test_the_readout_is_found_and_poses_with_it(readout, better):
    colmap = pytest.importorskip("pycolmap")
    random = np.random.default_rng(0)
    points, times = random.uniform(-1.2, 1.2, (150, 3)), STEP * np.arange(FRAMES)
    model = colmap.Reconstruction()
    camera = colmap.Camera(
        model=colmap.CameraModelId.PINHOLE, width=320, height=HEIGHT, camera_id=1,
        params=[250.0, 250.0, 160.0, 120.0],
    )  # fmt: skip
    model.add_camera_with_trivial_rig(camera)
    for k, time in enumerate(times):
        pixels = seen(points, time, readout) + random.normal(0, 0.01, (len(points), 2))
        image = colmap.Image(f"{k:06d}", [colmap.Point2D(p) for p in pixels], 1, k + 1)
        model.add_image_with_trivial_frame(image, colmap.Rigid3d(pose(time)[:3]))
    for n, point in enumerate(points):
        track = colmap.Track()
        for k in range(FRAMES):
            track.add_element(k + 1, n)
        model.add_point3D(point, track)

    def off(some) -> float:
        centres = torch.from_numpy(np.stack([i.projection_center() for i in placed_images(some)]))
        truth = torch.from_numpy(np.stack([np.linalg.inv(pose(t))[:3, 3] for t in times]))
        scale, R, t = umeyama(centres, truth)
        return float((scale * centres @ R.T + t - truth).norm(dim=1).mean())

    adjust_free(model, {1})
    found, unsure = with_rows_at_once(model, times, lambda some: adjust_free(some, {1}))
    assert off(found) * better <= off(model)
    assert off(found) < 4e-4
    assert unsure.shape == (FRAMES,)
    assert unsure.mean() > 0.1 * off(model) if readout else unsure.max() < 1e-4
