"""Jumps of depth maps against a loop over pixels, and what a plane and a step are."""

import numpy as np
import pytest
import torch

from geogs.geometry.jumps import JUMP, depth_jumps, minmod_slopes, widened


def slow_jumps(depth):
    """The definition, a pair of pixels at a time."""
    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-9), np.nan)
    near, far = np.zeros(depth.shape, bool), np.zeros(depth.shape, bool)
    for dy, dx in ((0, 1), (1, 0)):
        for y, x in np.ndindex(depth.shape):
            if y + dy >= depth.shape[0] or x + dx >= depth.shape[1]:
                continue
            here, there = (y, x), (y + dy, x + dx)
            step = inverse[there] - inverse[here]
            left = abs(step)
            if min(y - dy, x - dx) >= 0:
                left = min(left, abs(step - (inverse[here] - inverse[y - dy, x - dx])))
            if y + 2 * dy < depth.shape[0] and x + 2 * dx < depth.shape[1]:
                after = inverse[y + 2 * dy, x + 2 * dx] - inverse[there]
                left = np.fmin(left, abs(step - after)) if not np.isnan(after) else np.nan
            if left > JUMP * max(inverse[here], inverse[there]):
                nearer, farther = (there, here) if step > 0 else (here, there)
                near[nearer], far[farther] = True, True
    return near, far


def rough(seed=0, shape=(17, 23)):
    rng = np.random.default_rng(seed)
    depth = 2 + 0.02 * rng.standard_normal(shape)
    depth[4:11, 6:15] = 1.4
    depth[12:, :5] = 0
    return depth


def test_jumps_are_those_of_the_definition():
    depth = rough()
    found = depth_jumps(torch.from_numpy(depth))
    near, far = slow_jumps(depth)
    assert min(near.sum(), far.sum()) > 20
    # Where depth is unknown beside a pair, the slope there is unknown, too.
    known = ~widened(torch.from_numpy(depth <= 0), 2).numpy()
    assert (found.near.numpy() == near)[known].all()
    assert (found.far.numpy() == far)[known].all()
    assert not (found.near | found.far).numpy()[depth <= 0].any()


def test_a_slanted_plane_has_no_jump_and_a_step_has_two_sides():
    u = torch.arange(40.0).expand(30, 40)
    plane = 1 / (0.2 + 0.02 * u)  # 10 % from pixel to pixel at its far end
    assert not depth_jumps(plane).around(0).any()
    step = torch.full((30, 40), 3.0)
    step[:, 25:] = 2.0
    found = depth_jumps(step)
    assert found.near.nonzero()[:, 1].unique().tolist() == [25]
    assert found.far.nonzero()[:, 1].unique().tolist() == [24]
    assert found.around(2).nonzero()[:, 1].unique().tolist() == [22, 23, 24, 25, 26, 27]


def test_slopes_reach_across_no_step_and_nothing_unknown():
    u = torch.arange(12.0, dtype=torch.float64).expand(9, 12)
    inverse = 0.3 + 0.01 * u
    valid = torch.ones_like(inverse, dtype=torch.bool)
    valid[4, 3] = False
    right, down = minmod_slopes(torch.where(u >= 6, inverse - 0.2, inverse), valid)
    expected = torch.full_like(right, 0.01)
    expected[:, [0, 5, 6, 11]] = 0
    expected[4, 2:5] = 0
    assert right.numpy() == pytest.approx(expected.numpy(), abs=1e-12)
    assert float(down.abs().max()) == 0
