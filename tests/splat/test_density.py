"""Splitting disks: which, and into what."""

import pytest
import torch

from geogs.splat.density import split, spread_candidates, worth_splitting
from geogs.splat.optimizer import LearningRates, MapOptimizer
from geogs.world.disks import DiskParameters, GaussianMap

RATES = LearningRates(1e-3, 1e-3, 1e-3, 1e-3)


def disks(scales: list[list[float]]) -> GaussianMap:
    """Disks along x, turned by 90 degrees about z: their first axis is y."""
    n = len(scales)
    position = torch.stack([torch.arange(n).float(), torch.zeros(n), torch.zeros(n)], 1)
    quarter = torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5]).expand(n, 4)
    parameters = DiskParameters(
        position, quarter, torch.tensor(scales).log(), torch.arange(n).float()
    )
    return GaussianMap.of(parameters, torch.arange(n))


def test_the_hardest_pulled_of_the_large_disks_are_chosen() -> None:
    scene = disks([[0.2, 0.1], [0.2, 0.1], [0.01, 0.02], [0.1, 0.3]])
    pull = torch.tensor([1.0, 3.0, 9.0, 2.0])
    assert worth_splitting(scene, pull, 0.5, 0.05).tolist() == [False, True, False, True]
    assert worth_splitting(scene, pull, 0.99, 0.05).tolist() == [True, True, False, True]
    assert not worth_splitting(scene, pull, 0.0, 0.05).any()


def test_candidates_are_closer_together_at_edges() -> None:
    needed, at_edge = torch.ones(60, 80, dtype=torch.bool), torch.zeros(60, 80, dtype=torch.bool)
    needed[:10], at_edge[:, 34:46] = False, True
    random = torch.Generator().manual_seed(0)
    v, u, spacing = spread_candidates(needed, at_edge, 6, 2, random)
    near = (u >= 34) & (u < 46)
    assert torch.equal(spacing, torch.where(near, 2, 6))
    assert int(near.sum()) == 25 * 6  # every second row and column
    # One in every cell of 6 x 6 pixels; jitter takes some of them across the borders.
    assert abs(int((~near).sum()) - 50 * 68 / 36) < 15
    assert int(v.min()) >= 10


@pytest.mark.parametrize("edge_stride", [6, 50])
def test_candidates_at_edges_are_no_farther_apart_than_others(edge_stride: int) -> None:
    mask = torch.ones(30, 30, dtype=torch.bool)
    random = torch.Generator().manual_seed(0)
    *_, spacing = spread_candidates(mask, mask, 6, edge_stride, random)
    assert spacing.tolist() == [6] * 25


def test_halves_lie_in_the_plane_along_the_longer_axis() -> None:
    scene = disks([[0.4, 0.1], [0.1, 0.4]])
    halves = split(scene, torch.tensor([True, True]))
    first, second = halves.position[:2], halves.position[2:]
    torch.testing.assert_close((first + second) / 2, scene.position.detach())
    apart = second - first
    torch.testing.assert_close(apart[0].abs(), torch.tensor([0.0, 0.4, 0.0]), atol=1e-6, rtol=0)
    torch.testing.assert_close(apart[1].abs(), torch.tensor([0.4, 0.0, 0.0]), atol=1e-6, rtol=0)
    expected = torch.tensor([[0.25, 0.1], [0.1, 0.25]]).repeat(2, 1)
    torch.testing.assert_close(halves.log_scale.exp(), expected)
    assert halves.opacity_logit.tolist() == [0.0, 1.0, 0.0, 1.0]


def test_replaced_disks_keep_their_keyframe_and_start_without_moments() -> None:
    scene = disks([[0.4, 0.1], [0.1, 0.1], [0.3, 0.1]])
    optimizer = MapOptimizer(scene, RATES)
    scene.position.grad = torch.tensor([[3.0, 0, 4.0], [0, 0, 0.1], [0, 0, 1.0]])
    optimizer.step(torch.tensor([True, True, True]))
    assert optimizer.position_gradient.tolist() == pytest.approx([5.0, 0.1, 1.0], rel=1e-4)
    chosen = worth_splitting(scene, optimizer.position_gradient, 0.34, 0.05)
    assert chosen.tolist() == [True, False, False]
    ids = scene.keyframe_id[chosen]
    halves = split(scene, chosen)
    scene.keep(~chosen)
    scene.append(halves, torch.cat([ids, ids]))
    assert scene.keyframe_id.tolist() == [1, 2, 0, 0]
    assert optimizer.position_gradient.tolist() == pytest.approx([0.1, 1.0, 0.0, 0.0], rel=1e-4)
    assert scene.steps.tolist() == [1, 1, 0, 0]
