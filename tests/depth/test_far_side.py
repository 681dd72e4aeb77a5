"""The far side of edges in compiled loops, against the tensors that a GPU takes."""

import numpy as np
import pytest
import torch

from depth_scene import RENDER, make_scene
from geogs.depth.far_side import APART, farther_surface
from geogs.depth.far_side_cpu import CompiledPhotoVote, compiled_farther_surface
from geogs.depth.photo_vote import photo_vote


def steps(seed: int) -> torch.Tensor:
    """A rough depth map of slanted pieces that end at each other."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:60.0, :80.0]
    inverse = 0.3 + 0.001 * u + 0.0007 * v
    for _ in range(12):
        y, x = rng.integers(0, (60, 80))
        inside = (abs(v - y) < rng.integers(2, 15)) & (abs(u - x) < rng.integers(2, 20))
        slope = rng.normal(0, 0.002, 2)
        inverse[inside] = (rng.uniform(0.3, 0.9) + slope[0] * (u - x) + slope[1] * (v - y))[inside]
    return torch.from_numpy(1 / inverse.clip(0.1)).float()


@pytest.mark.parametrize("reach", [1, 3, 6])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_same_surfaces_go_on(seed, reach):
    depth = steps(seed)
    expected, found = farther_surface(depth, reach), compiled_farther_surface(depth, reach, APART)
    assert 0.02 < float((expected > 0).float().mean()) < 0.6
    same = (found - expected).abs() <= 1e-4 * expected
    assert float((~same).float().mean()) < 2e-3  # a plane that is at a limit by one rounding


def test_the_images_say_the_same():
    scene = make_scene()
    depth = torch.from_numpy(scene.truth[0]).clone()
    depth[20:40, 30:60] *= 0.8
    beyond = torch.zeros_like(depth)
    beyond[15:45, 25:70] = 1.1 * depth[15:45, 25:70]
    beyond[25:30, 40:45] *= 40  # out of most images
    views = scene.views[0], scene.views[1:]
    depths = torch.stack([depth, torch.where(beyond > 0, beyond, depth)])
    expected = photo_vote(*views, depths, beyond == 0, RENDER)
    found = CompiledPhotoVote(*views, RENDER)(depth, beyond)
    there = beyond > 0
    assert not found[~there].any()
    assert float(expected[there].abs().mean()) > 0.1
    assert float((found - expected)[there].abs().max()) < 2e-3


def test_nothing_is_said_of_pixels_without_depth():
    """What no depth is known of neither counts nor depends on what was in memory."""
    scene = make_scene()
    depth = torch.from_numpy(scene.truth[0]).clone()
    depth[:, :30] = 0
    beyond = torch.zeros_like(depth)
    beyond[10:30, 40:70] = 1.2 * depth[10:30, 40:70]
    vote = CompiledPhotoVote(scene.views[0], scene.views[1:], RENDER)
    found = vote(depth, beyond)
    assert torch.equal(found, vote(depth, beyond))
    assert float(found[10:30, 40:70].abs().mean()) > 0.05
    assert not found[:, :30].any()
