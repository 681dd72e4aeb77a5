"""Of a large map only what is looked at costs, and the result is the same."""

from dataclasses import replace

import pytest
import torch

from geogs.config import DiskConfig, MappingConfig
from geogs.depth.depth_view import DenseDepth
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.mapping.keyframe_views import KeyframeViews, MapView
from geogs.mapping.training import cpu as training
from geogs.mapping.training.cpu import CpuTrainer
from geogs.mapping.training.cuda.known_views import KnownViews
from geogs.mapping.view_arrays import MapCameras
from geogs.splat import init
from geogs.splat.cpu.in_view import disks_in_view
from geogs.splat.render import render
from geogs.world.disks import DiskParameters, GaussianMap
from keyframe_samples import Sample, add, segment_of, views_of

CAMERA = Camera(60.0, 60.0, 47.5, 35.5, 96, 72)
CAMERAS = MapCameras(CAMERA, CAMERA, CAMERA)


def some_disks(count: int, seed: int = 0) -> DiskParameters:
    """Disks all around the origin, up to 3 away."""
    random = torch.Generator().manual_seed(seed)
    return DiskParameters(
        6 * torch.rand(count, 3, generator=random) - 3,
        torch.randn(count, 4, generator=random),
        torch.empty(count, 2).uniform_(-5, -2, generator=random),
        torch.randn(count, generator=random),
    )


def test_no_disk_that_is_rendered_is_left_out():
    disks, missed = some_disks(3000), 0
    for seed in range(8):
        xi = torch.randn(6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        T = se3_exp(xi)
        shown = render(disks, CAMERA, T).visible
        radius = training.REACH * disks.log_scale.exp().amax(1)
        seen = disks_in_view(disks.position, radius, T[None], CAMERA)
        assert not bool((shown & ~seen).any())
        missed += int((~seen).sum())
    assert missed > 8 * 1500


def views() -> list[MapView]:
    random = torch.Generator().manual_seed(1)
    made, segment = [], segment_of([], CAMERA)
    pool = views_of(segment.table, CAMERAS, LOSS)
    for n in range(2):
        image = torch.randint(0, 255, (72, 96, 3), dtype=torch.uint8, generator=random).numpy()
        T = se3_exp(torch.tensor([0.1 * n, 0, 0, 0, 0.02 * n, 0], dtype=torch.float64))
        add(segment, Sample(n, image, T))
        view = pool.add(n)
        depth = 2 + torch.rand(72, 96, generator=random)
        view.set_depth(DenseDepth(depth, torch.ones_like(depth), depth.median()))
        made.append(view)
    return made


LOSS = MappingConfig().loss


def test_training_an_excerpt_is_training_the_map(monkeypatch):
    # Not by noise: where all is nearly quadratic, rounding is a larger part of what moves disks.
    # Nor far: later steps repeat the rounding of earlier ones, times what these moved.
    loss = replace(LOSS, l1_huber=0.35, photo_texture=0.0)
    config = replace(MappingConfig(), disk=DiskConfig(max_scale=1.0), loss=loss)
    trained = []
    for share in (0.7, 0.0):  # 0: always the whole map
        monkeypatch.setattr(training, "_LARGE_EXCERPT", share)
        disks = GaussianMap.empty()
        trainer = CpuTrainer(disks, CAMERAS, config, 2.0)
        disks.append(some_disks(2000), 5)
        a, b = views()
        trainer.train([[(a, [b])], [(b, [a])], [(a, []), (b, [a])]], [0.25, 0.12, 0.18])
        assert trainer.disks is trainer.optimizer.disks is disks
        trained.append(trainer)
        assert 0 < len(trainer._in_view([[(a, [])]])) < 0.7 * len(disks)
    first, second = trained
    # Equal but for the rounding of loops that are cut at other disks.
    for p, q in zip(first.disks.parameters, second.disks.parameters, strict=True):
        torch.testing.assert_close(p, q, rtol=0, atol=2e-6)
    for p, q in zip(first.disks.second, second.disks.second, strict=True):
        torch.testing.assert_close(p, q, rtol=1e-4, atol=1e-12)
    assert torch.equal(first.disks.steps, second.disks.steps)
    assert torch.equal(first.disks.seen, second.disks.seen)
    assert int(first.disks.seen.sum()) > 100
    assert first.disks.capacity == second.disks.capacity


def test_dropping_recent_disks_leaves_the_old_in_place():
    disks = GaussianMap.empty()
    disks.append(some_disks(1000), 0)
    before = disks.position.detach().clone()
    for gone in ([900, 950], [0, 5], [995]):
        mask = torch.ones(len(disks), dtype=torch.bool)
        mask[gone] = False
        disks.keep(mask)
        before = before[mask]
        assert torch.equal(disks.position.detach(), before)
        assert len(disks.first[0]) == len(before)


@pytest.mark.parametrize("spread", [1.0, 30.0])
def test_planes_of_a_large_map_are_fitted_to_the_same_neighbours(monkeypatch, spread):
    random = torch.Generator().manual_seed(3)
    points = torch.rand(60, 3, generator=random)
    context = spread * (4 * torch.rand(4000, 3, generator=random) - 2)
    found = init.fit_local_planes(points, context, 12)
    monkeypatch.setattr(init, "_MARGIN", 1e6)
    expected = init.fit_local_planes(points, context, 12)
    assert torch.equal(found.spacing, expected.spacing)
    assert torch.equal(found.planarity, expected.planarity)


def test_few_slots_serve_many_keyframes():
    """Slots on the GPU pass from keyframe to keyframe, and their maps stay where they are."""
    known = KnownViews(CAMERAS, torch.device("cpu"), 2)
    a, b = views()
    pose = se3_exp(torch.full((6,), 0.2, dtype=torch.float64))
    keyframes = a.arrays.keyframes
    keyframes.arrays.put("image", 7, a.keyframe.image)
    keyframes.poses[7] = pose
    keyframes.set_of[0].put(replace(a.keyframe, id=7))
    c = KeyframeViews(a.arrays).add(7)
    c.set_depth(a.dense)
    first = known.slots([a, b])
    known.table.rendered.fill_(1)
    addresses = known.table.pointers.clone()
    assert known.slots([b, c]) == [first[1], first[0]]
    assert torch.equal(known.table.pointers, addresses)
    assert known.table.generation == 0
    assert known.table.rendered[:2].tolist() == [0, 1]
    assert torch.equal(known.table.poses[first[0]], c.T_cw[:3].reshape(-1))
    maps = known.table._maps[first[0]]
    assert torch.equal(maps[2], c.constants.prior_depth)
    *planes, texture = known.table._photos[first[0]]
    assert torch.equal(torch.stack(planes), c.photo.planes)
    assert torch.equal(texture, c.photo.texture)
    assert len(set(known.slots([a, b, c]))) == 3  # more at once than there should be
    assert torch.equal(known.table.poses[known.slots([a])[0]], a.T_cw[:3].reshape(-1))
