"""Poses of the frames between keyframes."""

import numpy as np
import torch

from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.tracking.trajectory import depth_aware_weight, interpolate


def test_gaps_are_bridged_by_constant_motion_and_ends_are_held():
    xi = torch.tensor([0.3, -0.1, 0.2, 0.1, 0.2, -0.1], dtype=torch.float64)
    truth = [se3_exp(k * xi) for k in range(5)]
    known = [None, truth[1], None, truth[3], None]
    out = interpolate(np.arange(5.0), known)
    expected = [truth[1], truth[1], truth[2], truth[3], truth[3]]
    np.testing.assert_allclose(out, np.stack([se3_inverse(T).numpy() for T in expected]), atol=1e-9)


def test_nothing_known_is_the_identity():
    assert np.array_equal(interpolate(np.arange(2.0), [None, None]), np.tile(np.eye(4), (2, 1, 1)))


def test_uncertain_depth_lowers_the_weight_along_its_direction_only():
    weight = torch.full((1, 1, 2), 25.0)
    slope = torch.tensor([[[10.0, 0.0]]])
    information = torch.tensor([[100.0]])
    out = depth_aware_weight(weight, slope, information)
    torch.testing.assert_close(out, torch.tensor([[[1 / (0.04 + 1.0), 25.0]]]))
    assert float(depth_aware_weight(weight, slope, 0 * information).max()) == 0
