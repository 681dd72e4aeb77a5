"""Points in the images of a clip: one by one, and derivatives by differences."""

import numpy as np
import torch

from geogs.camera.shutter.clip_reconstruction import ClipReconstruction
from geogs.geometry.lie import so3_exp


def sample() -> ClipReconstruction:
    rng = np.random.default_rng(3)
    R = np.stack([so3_exp(torch.tensor(w)).numpy() for w in rng.normal(0, 0.2, (4, 3))])
    points = np.column_stack([rng.uniform(-0.6, 0.6, (7, 2)), rng.uniform(0.1, 1.5, 7)])
    return ClipReconstruction(R, rng.normal(0, 0.2, (4, 3)), points)


def test_projections_one_by_one():
    scene = sample()
    projected = scene.projected()
    for k in range(4):
        for n, (x, y, d) in enumerate(scene.points):
            at = scene.R[k] @ np.array([x, y, 1.0]) / d + scene.t[k]
            np.testing.assert_allclose(projected[k, n], at[:2] / at[2], atol=1e-12)


def test_derivatives_agree_with_differences():
    """A step changes the scale, too, which nothing that is seen depends on."""
    scene, small = sample(), 1e-6
    by_pose, by_point = scene.derivatives()
    for k, unit in enumerate(small * np.eye(6)):
        steps = np.tile(unit, (4, 1)), np.zeros((7, 3))
        ends = [scene.stepped(sign * steps[0], steps[1]).projected() for sign in (1, -1)]
        np.testing.assert_allclose(by_pose[..., k], (ends[0] - ends[1]) / (2 * small), atol=1e-7)
    for k, unit in enumerate(small * np.eye(3)):
        steps = np.zeros((4, 6)), np.tile(unit, (7, 1))
        ends = [scene.stepped(steps[0], sign * steps[1]).projected() for sign in (1, -1)]
        np.testing.assert_allclose(by_point[..., k], (ends[0] - ends[1]) / (2 * small), atol=1e-7)


def test_a_step_keeps_rotations_and_the_unit():
    rng = np.random.default_rng(0)
    scene = sample().stepped(rng.normal(0, 0.3, (4, 6)), rng.normal(0, 0.1, (7, 3)))
    unit = np.tile(np.eye(3), (4, 1, 1))
    np.testing.assert_allclose(scene.R @ np.swapaxes(scene.R, 1, 2), unit, atol=1e-12)
    np.testing.assert_allclose(np.median(np.abs(scene.points[:, 2])), 1.0)
