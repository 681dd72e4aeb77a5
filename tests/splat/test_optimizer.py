"""Adam on a changing set of disks."""

import math

import torch

from geogs.geometry.lie import sim3_exp
from geogs.splat.cpu.adam import adam_rows
from geogs.splat.optimizer import LearningRates, MapOptimizer
from geogs.world.disks import DiskParameters, GaussianMap
from oracles.adam_reference import adam_reference

RATES = LearningRates(position=1e-2, quaternion=2e-2, log_scale=3e-2, opacity_logit=5e-2)


def new_disks(n: int, seed: int = 0) -> DiskParameters:
    g = torch.Generator().manual_seed(seed)
    sizes = [(n, 3), (n, 4), (n, 2), (n,)]
    return DiskParameters(*(torch.randn(s, generator=g) for s in sizes))


def optimizer_of(n: int) -> MapOptimizer:
    optimizer = MapOptimizer(GaussianMap.empty(), RATES)
    optimizer.disks.append(new_disks(n), 0)
    return optimizer


def set_gradients(disks: GaussianMap, seed: int) -> None:
    for p, g in zip(disks.parameters, new_disks(len(disks), seed), strict=True):
        p.grad = g


def test_equals_adam_while_everything_is_visible() -> None:
    optimizer = optimizer_of(50)
    disks = optimizer.disks
    copies = [p.detach().clone().requires_grad_() for p in disks.parameters]
    groups = [{"params": [p], "lr": lr} for p, lr in zip(copies, RATES, strict=True)]
    expected = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-8)
    for step in range(30):
        set_gradients(disks, 100 + step)
        for p, q in zip(copies, disks.parameters, strict=True):
            p.grad = q.grad.clone()
        optimizer.step(torch.ones(50, dtype=torch.bool))
        expected.step()
    for p, q in zip(copies, disks.parameters, strict=True):
        assert torch.allclose(p, q, atol=2e-6)
    assert disks.steps.tolist() == [30] * 50


def test_fused_kernel_equals_the_plain_step() -> None:
    optimizer = optimizer_of(40)
    corrections = optimizer._corrections
    g = torch.Generator().manual_seed(5)
    for width in ((40, 3), (40,)):
        p = torch.randn(width, generator=g)
        state = [p, torch.zeros(width), torch.zeros(width)]
        fast, slow = [s.clone() for s in state], [s.clone() for s in state]
        steps = torch.randint(0, 3000, (40,), generator=g)
        for _ in range(5):
            grad, visible = torch.randn(width, generator=g), torch.rand(40, generator=g) > 0.4
            steps += visible
            for update, (x, m, v) in ((adam_rows, fast), (adam_reference, slow)):
                update(x, grad, m, v, visible, steps, corrections, 0.1, (0.9, 0.99), 1e-8)
        for a, b in zip(fast, slow, strict=True):
            assert torch.allclose(a, b, rtol=1e-5, atol=1e-6)
        assert (fast[0] - p).abs().max() > 0.05


def test_hidden_disks_stand_still() -> None:
    optimizer = optimizer_of(10)
    disks = optimizer.disks
    everything = torch.ones(10, dtype=torch.bool)
    set_gradients(disks, 1)
    optimizer.step(everything)
    before = [p.detach().clone() for p in disks.parameters]
    moments = [m.clone() for m in optimizer.disks.first + optimizer.disks.second]
    visible = torch.arange(10) < 6
    set_gradients(disks, 2)
    optimizer.step(visible)
    for p, old in zip(disks.parameters, before, strict=True):
        assert torch.equal(p[6:], old[6:])
        assert not torch.equal(p[:6], old[:6])
    for m, old in zip(optimizer.disks.first + optimizer.disks.second, moments, strict=True):
        assert torch.equal(m[6:], old[6:])
    assert disks.steps.tolist() == [2] * 6 + [1] * 4


def test_moments_survive_insertion_and_pruning() -> None:
    """A disk's path is the same with and without others coming and going."""
    paths = []
    for busy in (False, True):
        optimizer = optimizer_of(6)
        for step in range(8):
            n = len(optimizer.disks)
            gradients = new_disks(6, 50 + step)
            for p, g in zip(optimizer.disks.parameters, gradients, strict=True):
                p.grad = torch.zeros_like(p)
                p.grad[-4:] = g[-4:] if n == 6 or not busy else g[2:]
            optimizer.step(torch.ones(n, dtype=torch.bool))
            if busy and step == 3:
                optimizer.disks.append(new_disks(5, 9), 1)
                optimizer.disks.keep(torch.tensor([False, False] + [True] * 4 + [False] * 5))
        paths.append([p.detach()[-4:] for p in optimizer.disks.parameters])
        assert optimizer.disks.steps[-4:].tolist() == [8] * 4
    for a, b in zip(*paths, strict=True):
        assert torch.equal(a, b)


def test_zero_grad_and_missing_gradients() -> None:
    optimizer = optimizer_of(3)
    set_gradients(optimizer.disks, 1)
    optimizer.zero_grad()
    before = [p.detach().clone() for p in optimizer.disks.parameters]
    optimizer.disks.parameters.opacity_logit.grad = torch.ones(3)
    optimizer.step(torch.ones(3, dtype=torch.bool))
    after = optimizer.disks.parameters
    assert all(torch.equal(a, b) for a, b in zip(after[:3], before[:3], strict=True))
    assert torch.allclose(after[3], before[3] - RATES.opacity_logit, atol=1e-6)


def train(optimizer: MapOptimizer, steps: range, S: torch.Tensor) -> None:
    """Steps whose gradients are those of one fixed loss of the world before S."""
    scale = torch.linalg.det(S[:3, :3]) ** (1 / 3)
    R = (S[:3, :3] / scale).float()
    for step in steps:
        g = new_disks(len(optimizer.disks), 200 + step)
        optimizer.disks.position.grad = g.position @ R.mT / scale.float()
        optimizer.step(torch.ones(len(optimizer.disks), dtype=torch.bool))


def test_motion_carries_the_moments_along() -> None:
    # A cyclic permutation of the axes keeps a diagonal covariance diagonal, so it is exact.
    angle = 2 * math.pi / 3 / math.sqrt(3)
    S = sim3_exp(torch.tensor([0, 0, 0, angle, angle, angle, 0.5], dtype=torch.float64))
    still, moving = optimizer_of(8), optimizer_of(8)
    identity = torch.eye(4, dtype=torch.float64)
    train(still, range(5), identity)
    train(moving, range(5), identity)
    start, moved_start = still.disks.position.detach().clone(), None
    moving.disks.transform(S)
    moved_start = moving.disks.position.detach().clone()
    assert torch.allclose(moved_start.double(), start.double() @ S[:3, :3].mT, atol=1e-5)
    train(still, range(5, 8), identity)
    train(moving, range(5, 8), S)
    R = (S[:3, :3] / math.exp(0.5)).float()
    step, moved_step = still.disks.position - start, moving.disks.position - moved_start
    assert torch.allclose(moved_step, step @ R.mT, atol=1e-5)
    assert step.abs().max() > 0.01


def test_quaternion_moments_turn_with_the_quaternion() -> None:
    S = sim3_exp(torch.tensor([0, 0, 0, math.pi, 0, 0, 0], dtype=torch.float64))
    optimizer = optimizer_of(5)
    set_gradients(optimizer.disks, 3)
    optimizer.step(torch.ones(5, dtype=torch.bool))
    first, second = optimizer.disks.first[1].clone(), optimizer.disks.second[1].clone()
    optimizer.disks.transform(S)
    # i (w, x, y, z) = (-x, w, -z, y)
    sign = torch.tensor([-1.0, 1, -1, 1])
    assert torch.allclose(optimizer.disks.first[1], sign * first[:, [1, 0, 3, 2]], atol=1e-6)
    assert torch.allclose(optimizer.disks.second[1], second[:, [1, 0, 3, 2]], atol=1e-6)


def test_a_similarity_per_disk_is_accepted() -> None:
    optimizer = optimizer_of(4)
    set_gradients(optimizer.disks, 3)
    optimizer.step(torch.ones(4, dtype=torch.bool))
    before = optimizer.disks.first[0].clone()
    optimizer.disks.transform(torch.eye(4, dtype=torch.float64).repeat(4, 1, 1))
    assert torch.allclose(optimizer.disks.first[0], before, atol=1e-7)
    optimizer.step(torch.ones(4, dtype=torch.bool))
