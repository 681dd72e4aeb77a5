"""Training on the GPU's kernels against training on the CPU's, emulated and on a GPU."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from cuda_emulator import use_emulator
from geogs.geometry.lie import retract, se3_exp
from geogs.losses.cuda import window_losses
from geogs.mapping.training.cpu import CpuTrainer
from geogs.mapping.training.cuda import trainer as cuda_trainer
from geogs.mapping.training.cuda.trainer import CudaTrainer
from geogs.splat.cuda import rasterize
from geogs.world.disks import DiskParameters
from keyframe_samples import Sample
from trained_room import (
    CAMERAS,
    CONFIG,
    UNIT,
    make_batches,
    make_map,
    make_views,
    rendered_keyframes,
)  # fmt: skip

pytestmark = pytest.mark.system


@pytest.fixture(params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """Where the kernels run."""
    if request.param == "emulated":
        use_emulator(monkeypatch, rasterize, window_losses, cuda_trainer)
        return torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("needs an NVIDIA GPU")
    return torch.device("cuda")


@pytest.fixture(scope="module")
def rendered() -> list[tuple[Sample, np.ndarray]]:
    return rendered_keyframes()


@pytest.fixture
def pair(
    rendered, device: torch.device
) -> Callable[[], tuple[CudaTrainer, CpuTrainer, list, list]]:
    """A CUDA and a CPU trainer of equal maps, each with its views."""

    def make(config=CONFIG):
        cpu = torch.device("cpu")
        fast = CudaTrainer(make_map(rendered, device), CAMERAS, config, UNIT, 128)
        slow = CpuTrainer(make_map(rendered, cpu), CAMERAS, config, UNIT)
        return fast, slow, make_views(rendered, device, config), make_views(rendered, cpu, config)

    return make


def moved(before: torch.Tensor, a: torch.Tensor, b: torch.Tensor) -> float:
    """Distance of two results over the way that the second has gone."""
    return float((a.cpu() - b).norm() / (b - before).norm().clamp(min=1e-12))


FRESH = replace(
    CONFIG,
    photo=replace(CONFIG.photo, fresh=True),
    loss=replace(CONFIG.loss, colour=True, ssim_weight=0.2),
)


@pytest.mark.parametrize("config", [CONFIG, FRESH], ids=["default", "fresh colours"])
def test_steps_equal_those_of_the_cpu(pair, rendered, config) -> None:
    fast, slow, fast_views, slow_views = pair(config)
    start = [p.detach().clone() for p in make_map(rendered, torch.device("cpu")).parameters]
    factors = [1.0, 0.5, 0.7]
    fast.train(make_batches(fast_views), factors)
    slow.train(make_batches(slow_views), factors)
    names = DiskParameters._fields
    for name, p, a, b in zip(
        names, start, fast.disks.parameters, slow.disks.parameters, strict=True
    ):
        # Adam's first steps are signs of gradients, so single disks with tiny ones may differ.
        assert moved(p, a.detach(), b.detach()) < 0.08, name
    same_steps = (fast.disks.steps.cpu() == slow.disks.steps).float().mean()
    same_seen = (fast.disks.seen.cpu() == slow.disks.seen).float().mean()
    assert same_steps > 0.99
    assert same_seen > 0.99
    assert int(slow.disks.steps.max()) == 3
    for a, b in zip(fast_views, slow_views, strict=True) if config is FRESH else ():
        shown = fast.known.table.rendered_depth(fast.known.slots([a])[0]).cpu()
        assert b.rendered_depth is not None
        assert ((shown > 0) == (b.rendered_depth > 0)).float().mean() > 0.98


def test_steps_without_room_are_done_again(pair) -> None:
    fast, _, views, _ = pair()
    other, _, same_views, _ = pair()
    batches = [[(views[0], [])]] * 3
    fast.train(batches[:1])
    program = fast._programs[1, CONFIG.photo.per_step]
    rasterizer = program.window.rasterizer
    needed = int(rasterizer.status[0])
    rasterizer._keys, rasterizer._disks = rasterizer._keys[:100], rasterizer._disks[:100]
    program._graph = None
    fast.train(batches[1:])
    assert rasterizer.room >= needed > 100
    other.train([[(same_views[0], [])]] * 3)
    assert int(fast.disks.steps.max()) == 3
    assert torch.equal(fast.disks.steps, other.disks.steps)
    for a, b in zip(fast.disks.parameters, other.disks.parameters, strict=True):
        assert torch.allclose(a, b, atol=1e-4)


@pytest.mark.long
def test_growing_and_dropping_between_steps(pair) -> None:
    fast, _, views, _ = pair()
    fast.train([[(views[0], [views[1]])]])
    copies = fast.disks.capacity // len(fast.disks)
    more = DiskParameters(*(p.detach().clone() for p in fast.disks.parameters))
    capacity = fast.disks.capacity
    for _ in range(copies):
        fast.disks.append(more, 1)
    assert fast.disks.capacity > capacity
    fast.train([[(views[1], [views[0]])]])
    n = len(fast.disks)
    assert len(fast.disks.first[0]) == n
    fast.disks.keep(fast.disks.keyframe_id == 1)
    before = fast.disks.position.detach().clone()
    fast.train([[(views[0], [])]] * 2)
    assert len(fast.disks) == n * copies // (copies + 1)
    assert not torch.equal(fast.disks.position.detach(), before)
    assert torch.isfinite(fast.disks.position).all()


@pytest.mark.long
def test_poses_equal_those_of_the_cpu(pair, rendered) -> None:
    fast, slow, fast_views, slow_views = pair()
    config = replace(CONFIG, pose_iterations=4, pose_lr=1e-3)
    results = []
    for trainer, views in ((fast, fast_views), (slow, slow_views)):
        trainer.train([[(v, [])] for v in views])
        g = torch.Generator().manual_seed(1)
        for view in views[1:]:
            xi = 0.004 * torch.randn(6, dtype=torch.float64, generator=g)
            view.keyframe.T_cw = retract(xi, view.T_cw)
        start = {v.id: v.T_cw for v in views}
        poses = trainer.refine_poses(views, {v.id: v for v in views}, config)
        results.append((start, poses))
    (_, a), (start, b) = results
    assert sorted(a) == sorted(b) == [1, 2, 3]
    for i in b:
        step = (b[i] - start[i]).norm()
        assert step > 1e-4
        assert (a[i] - b[i]).norm() < 0.2 * step
    # The table has the poses of the last trial; training takes the views' again.
    slots = fast.known.slots(fast_views)
    kept = torch.stack([v.T_cw for v in fast_views])[:, :3].reshape(-1, 12)
    assert torch.allclose(fast.known.table.poses[slots].cpu(), kept)
    assert torch.allclose(se3_exp(torch.zeros(6)), torch.eye(4))
