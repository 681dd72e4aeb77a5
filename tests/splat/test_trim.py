"""Disks that are cut back where they reach into free space."""

import math

import torch

from geogs.geometry.lie import quaternion_to_matrix
from geogs.splat.trim import REACH, SAMPLES, spokes, trimmed
from geogs.world.disks import DiskParameters


def some_disks(n: int) -> DiskParameters:
    random = torch.Generator().manual_seed(3)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=random)

    return DiskParameters(draw(n, 3), draw(n, 4), 0.3 * draw(n, 2) - 2, draw(n))


def trimmed_one_by_one(
    disks: DiskParameters, is_free: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    position, log_scale = disks.position.clone(), disks.log_scale.clone()
    axes = quaternion_to_matrix(disks.quaternion)
    for n in range(len(position)):
        for axis in range(2):
            end = REACH * math.exp(float(disks.log_scale[n, axis]))
            ends = []
            for way in is_free[n, axis].tolist():
                first = way.index(True) if True in way else None
                ends.append(end if first is None else end * (first + 1) / (SAMPLES + 1))
            position[n] += (ends[0] - ends[1]) / 2 * axes[n, :, axis]
            log_scale[n, axis] = math.log((ends[0] + ends[1]) / 2 / REACH)
    return position, log_scale


def test_trimmed_disks_are_those_of_the_slow_way() -> None:
    disks = some_disks(200)
    free = torch.rand(200, 2, 2, SAMPLES, generator=torch.Generator().manual_seed(1)) < 0.3
    for own, slow in zip(trimmed(disks, free), trimmed_one_by_one(disks, free), strict=True):
        torch.testing.assert_close(own, slow, atol=1e-5, rtol=1e-5)


def test_where_nothing_is_free_nothing_changes() -> None:
    disks = some_disks(20)
    position, log_scale = trimmed(disks, torch.zeros(20, 2, 2, SAMPLES, dtype=torch.bool))
    assert torch.equal(position, disks.position)
    assert torch.equal(log_scale, disks.log_scale)


def test_spokes_lie_in_the_plane_of_a_disk_up_to_its_reach() -> None:
    disks = some_disks(50)
    way = spokes(disks) - disks.position[:, None, None, None]
    normal = quaternion_to_matrix(disks.quaternion)[..., 2]
    assert float((way * normal[:, None, None, None]).sum(-1).abs().max()) < 1e-6
    length = way.norm(dim=-1) / disks.log_scale.exp()[:, :, None, None]
    expected = REACH * torch.arange(1, SAMPLES + 1) / (SAMPLES + 1)
    torch.testing.assert_close(length, expected.expand_as(length))
    torch.testing.assert_close(way[:, :, 0], -way[:, :, 1])


def test_a_disk_that_overhangs_an_edge_ends_there() -> None:
    """A surface ends at x = 0: disks around that are cut to what lies on it."""
    x = torch.linspace(-0.5, 0.0, 26)
    position = torch.stack([x, torch.zeros(26), torch.ones(26)], 1)
    unit = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(26, 4)
    scale = torch.tensor([0.1, 0.05]).log().expand(26, 2)
    disks = DiskParameters(position, unit, scale, torch.zeros(26))
    points = spokes(disks)
    new, log_scale = trimmed(disks, points[..., 0] > 1e-6)
    step = REACH * 0.1 / (SAMPLES + 1)
    right = new[:, 0] + REACH * log_scale[:, 0].exp()
    left = new[:, 0] - REACH * log_scale[:, 0].exp()
    assert bool((right < step + 1e-5).all())
    torch.testing.assert_close(left, x - REACH * 0.1)  # on the surface it keeps its end
    assert torch.equal(log_scale[:, 1], scale[:, 1])
    far = x + REACH * 0.1 <= step
    assert bool(far.any())
    assert torch.equal(new[far], position[far])
