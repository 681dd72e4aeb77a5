"""Poses where there are only orientations, or nothing."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from geogs.tracking.frames.interpolation import bridged


def camera(centre: float, yaw: float) -> tuple[torch.Tensor, torch.Tensor]:
    """World to camera at a place along x, turned by an angle; and its rotation."""
    R = torch.from_numpy(Rotation.from_rotvec([0.0, yaw, 0.0]).as_matrix())
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3], T[:3, 3] = R, -R @ torch.tensor([centre, 0, 0], dtype=torch.float64)
    return T, R


def test_orientations_stay_and_places_are_bridged() -> None:
    times = np.arange(6.0)
    poses = [None, camera(1.0, 0.0)[0], None, None, camera(4.0, 0.3)[0], None]
    turned = [camera(0, 2.0)[1], None, camera(0, 1.0)[1], None, None, camera(0, -1.0)[1]]
    found = bridged(times, poses, turned)
    assert found.states == [
        "orientation only", "tracked", "orientation only", "lost", "tracked", "orientation only",
    ]  # fmt: skip
    np.testing.assert_allclose(found.T_wc[:, 0, 3][[0, 1, 2, 4, 5]], [1, 1, 2, 4, 4], atol=1e-12)
    for n, R in enumerate(turned):
        if R is not None:
            np.testing.assert_allclose(found.T_wc[n, :3, :3], R.mT.numpy(), atol=1e-12)


def test_orientations_alone_have_one_place() -> None:
    turned = [camera(0, 0.1 * k)[1] for k in range(4)]
    found = bridged(np.arange(4.0), [None] * 4, turned)
    assert (found.T_wc[:, :3, 3] == 0).all()
    assert found.states == ["orientation only"] * 4
    np.testing.assert_allclose(found.T_wc[3, :3, :3], turned[3].mT.numpy(), atol=1e-12)
