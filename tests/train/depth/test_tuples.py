"""Samples of the depth network's training: geometry that holds, and disturbances as asked for."""

import math
from dataclasses import replace

import pytest
import torch

from depth_tuples import TRAINING
from geogs.depth.network.plane_views import cell_rays
from geogs_synth.clips.sampler import RoomSampler
from geogs_synth.draw import Draw
from geogs_train.course import Worker
from geogs_train.depth.clip_pool import ClipPool, StoredClips
from geogs_train.depth.depth_options import TupleOptions
from geogs_train.depth.depth_tuples import disturbed_poses, draw_tuples, known_range, relit
from random_rooms import use_fast_rooms

EXACT = TupleOptions(dud=0.0, missing=0.0, disturbed=0.0, photometric=0.0)


def draw(seed: int = 0) -> Draw:
    return Draw(torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def stored() -> StoredClips:
    with pytest.MonkeyPatch.context() as patch:
        use_fast_rooms(patch)
        rooms = replace(TRAINING.rooms, views=9, disturbance=0.0, light_change=0.0)
        return StoredClips.of(RoomSampler(rooms, "cpu", 5).sample(0, 6))


def test_true_depth_takes_pixels_to_where_neighbours_show_the_same(stored):
    batch = draw_tuples(stored, 24, 3, EXACT, draw())
    height, width = batch.depth.shape[-2:]
    rays = cell_rays(batch.views.intrinsics, height, width, 1)

    def difference(factor: float) -> float:
        """Median difference of colours between keyframes and neighbours at wrong depths."""
        total = []
        for k in range(3):
            T, lens = batch.views.T_nk[:, k], batch.views.other_intrinsics[:, k]
            point = factor * batch.depth.flatten(1)[:, None] * rays
            y = T[:, :3, :3] @ point + T[:, :3, 3:]
            x = lens[:, :2, None] * y[:, :2] / y[:, 2:].clamp_min(0.1) + lens[:, 2:, None]
            grid = ((2 * x + 1) / torch.tensor([[width], [height]]) - 1).mT[:, None]
            shown = torch.nn.functional.grid_sample(
                batch.views.others[:, k], grid, align_corners=False
            )
            away = (shown - batch.views.image.flatten(2)[:, :, None]).abs().mean(1)[:, 0]
            inside = (grid.abs() < 1).all(-1)[:, 0]
            total.append(away[inside])
        return float(torch.cat(total).quantile(0.6))

    assert difference(1.0) < 0.35 * min(difference(0.7), difference(1.5))
    assert difference(1.0) < 0.012


def test_neighbours_are_others_of_the_same_clip_with_a_useful_baseline(stored):
    batch = draw_tuples(stored, 64, 3, EXACT, draw(1))
    baseline = batch.views.T_nk[..., :3, 3].norm(dim=-1)
    assert baseline.min() > 0
    median = stored.quantiles[batch.place[:, 0], batch.place[:, 1], 1]
    ratio = baseline / median[:, None]
    good = (ratio > EXACT.least_baseline) & (ratio < EXACT.most_baseline)
    assert good.float().mean() > 0.6
    own = stored.images[batch.place[:, 0], batch.place[:, 1]].float() / 255
    torch.testing.assert_close(batch.views.image, own.clamp_min(1e-3), atol=1e-5, rtol=0)


def test_the_range_holds_most_depths_and_its_ratio_is_bounded(stored):
    low, typical, high = stored.quantiles[0].unbind(-1)
    near, far, middle = known_range(low, typical, high, TupleOptions(), draw(2))
    assert ((far / near) >= 6 - 1e-3).all()
    assert ((far / near) <= 60 + 1e-2).all()
    assert (near < 0.9 * low).float().mean() > 0.7
    assert (far > 1.2 * high).all()
    assert ((middle / typical) > 0.74).all()
    assert ((middle / typical) < 1.36).all()


def test_poses_are_off_by_what_is_asked_for():
    T = torch.eye(4).repeat(400, 3, 1, 1)
    T[..., 0, 3] = 0.2
    options = TupleOptions(disturbed=0.5, rotation=(0.2, 0.2), translation=(0.02, 0.02))
    wrong = disturbed_poses(T, options, draw(3))
    moved = (wrong - T).abs().amax((1, 2, 3)) > 0
    assert 0.4 < moved.float().mean() < 0.6
    off = wrong[moved][..., :3, 3] - T[moved][..., :3, 3]
    # The turn about the neighbour's centre adds 0.2 times 0.2 degrees.
    assert float(off.std()) == pytest.approx(0.02 * 0.2, rel=0.15)
    trace = wrong[moved][..., :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1)
    angle = ((trace - 1) / 2).clamp(-1, 1).arccos()
    assert float(angle.square().mean().sqrt()) == pytest.approx(math.radians(0.2) * 3**0.5, rel=0.1)


def test_light_changes_view_by_view():
    images = torch.full((40, 3, 3, 8, 8), 0.5)
    torch.testing.assert_close(relit(images, 0.0, draw()), images)
    changed = relit(images, 1.0, draw()).mean((2, 3, 4))
    assert 0.05 < float(changed.std()) < 0.15
    assert float((changed[:, 0] - changed[:, 1]).abs().mean()) > 0.03


def test_a_pool_goes_on_as_if_it_had_never_stopped(monkeypatch):
    use_fast_rooms(monkeypatch)
    rooms = RoomSampler(replace(TRAINING.rooms, width=32, height=32), "cpu", 1)
    pool, later = (ClipPool(rooms, 2, 1, Worker(torch.device("cpu"))) for _ in range(2))
    for turn in range(3):
        found = pool.at(turn)
    for mine, theirs in zip(vars(found).values(), vars(later.at(2)).values(), strict=True):
        assert torch.equal(mine, theirs)
    assert not torch.equal(found.depth[0], found.depth[1])
    assert torch.equal(pool.at(2).depth, found.depth)
