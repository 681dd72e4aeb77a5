"""Moving and merging disks against loops over them."""

import math

import numpy as np
import torch

from geogs.geometry.lie import quaternion_to_matrix, se3_exp, sim3_exp, sim3_inverse, sim3_scale
from geogs.types import MapSnapshot
from geogs.world.loops import ImageFeatures
from geogs_fleet.join.joined_disks import is_covered, joined_disks, kept, overall, transformed
from geogs_fleet.join.part import PartViews


def some_disks(n: int, seed: int, size: float = 0.1) -> MapSnapshot:
    random = torch.Generator().manual_seed(seed)
    q = torch.randn(n, 4, generator=random)
    return MapSnapshot(
        torch.rand(n, 3, generator=random), q / q.norm(dim=1, keepdim=True),
        size * (0.5 + torch.rand(n, 2, generator=random)), torch.rand(n, generator=random),
    )  # fmt: skip


def test_disks_move_turn_and_grow_each_by_its_own_similarity():
    disks = some_disks(6, 0)
    xi = 0.3 * torch.randn(6, 7, generator=torch.Generator().manual_seed(1)).double()
    S = sim3_exp(xi)
    moved = transformed(disks, S)
    for k in range(6):
        s = float(sim3_scale(S[k]))
        position = S[k] @ torch.cat([disks.position[k].double(), torch.ones(1)])
        axes = S[k, :3, :3] / s @ quaternion_to_matrix(disks.quaternion[k].double())
        assert torch.allclose(moved.position[k].double(), position[:3], atol=1e-5)
        assert torch.allclose(quaternion_to_matrix(moved.quaternion[k]).double(), axes, atol=1e-5)
        assert torch.allclose(moved.scale[k], s * disks.scale[k], rtol=1e-4)
    assert torch.allclose(moved.opacity, disks.opacity, atol=1e-5)


def test_a_disk_is_covered_where_one_near_it_reaches_and_turns_alike():
    disks, others = some_disks(60, 2), some_disks(8, 3, 0.3)
    covered = is_covered(disks, others)
    for k in range(60):
        expected = False
        for m in range(8):
            axes = quaternion_to_matrix(others.quaternion[m])
            x, y, z = ((disks.position[k] - others.position[m]) @ axes).tolist()
            a, b = others.scale[m].tolist()
            alike = float(disks.normal[k] @ axes[:, 2]) > 0.8
            reaches = math.hypot(x / a, y / b) < 2
            expected |= reaches and abs(z) < (a + b) / 2 and alike
        assert bool(covered[k]) == expected, k
    assert 1 < int(covered.sum()) < 30
    assert not is_covered(disks, some_disks(0, 0)).any()


def test_disks_are_kept_and_joined():
    disks = some_disks(5, 4)
    keep = torch.tensor([True, False, True, False, True])
    both = joined_disks([kept(disks, keep), kept(disks, ~keep)])
    assert torch.equal(both.position, disks.position[[0, 2, 4, 1, 3]])


def test_one_similarity_of_all_keyframes_is_found():
    steps = 0.2 * torch.randn(5, 6, generator=torch.Generator().manual_seed(5)).double()
    T_cw = se3_exp(steps)
    ones = np.full((5, 4), 0.5, np.float32)
    none = ImageFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8))
    views = PartViews(T_cw.numpy(), np.arange(5.0), ones, ones, (none,) * 5)
    S = sim3_exp(torch.tensor([0.5, -1.0, 0.2, 0.3, -0.2, 0.1, 0.4]).double())
    assert torch.allclose(overall(views, S.expand(5, 4, 4)), S, atol=1e-9)
    a_bit = sim3_exp(0.01 * torch.randn(5, 7, generator=torch.Generator().manual_seed(6)).double())
    error = (overall(views, a_bit @ S) @ sim3_inverse(S) - torch.eye(4)).abs().max()
    assert 1e-6 < float(error) < 0.05
