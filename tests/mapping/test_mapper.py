"""The mapper on rendered keyframes with known depth and poses."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geogs.config import Config, MappingConfig
from geogs.geometry.lie import retract, se3_exp, se3_inverse
from geogs.mapping.mapper import Mapper
from geogs.mapping.training.map_trainer import draw_views
from geogs.types import PoseCorrection
from geogs_synth.sequence.location import centred_camera
from handheld_walk import handheld_trajectory
from keyframe_samples import Sample, add, segment_of
from lit_rooms import lit_room
from records import copied

pytestmark = pytest.mark.system

CAMERA = centred_camera(224, 168)
MAPPING = replace(
    Config().mapping,
    render_long_edge=112,
    iterations=8,
    lag=2,
    final_iterations=40,
    disk=replace(Config().mapping.disk, stride=2),
)


@pytest.fixture(scope="module")
def sequence() -> tuple[list[Sample], list[np.ndarray]]:
    """Nine keyframes with noisy grid depth, a fifth of it wrong, and their true depth maps."""
    caster = lit_room(3)
    poses = handheld_trajectory(caster.scene, 64)
    random = np.random.default_rng(0)
    keyframes, truth = [], []
    for index in range(0, 63, 7):
        view = caster.render(CAMERA, poses[index])
        z = view.depth[4 : CAMERA.height - 3 : 8, 4 : CAMERA.width - 3 : 8].astype(np.float64)
        deviation = np.where(random.random(z.shape) < 0.2, 0.4, 0.02)
        noisy = z * np.exp(deviation * random.standard_normal(z.shape))
        keyframes.append(
            Sample(
                index, view.image, se3_inverse(torch.from_numpy(poses[index])),
                torch.from_numpy(1 / noisy).float(),
                torch.from_numpy((noisy / deviation) ** 2).float(),
            )
        )  # fmt: skip
        small = caster.render(CAMERA.with_long_edge(112), poses[index])
        truth.append(small.depth)
    return keyframes, truth


def build(samples: list[Sample], config: MappingConfig = MAPPING, resident: int = 128) -> Mapper:
    mapper = Mapper(segment_of(samples, CAMERA, resident=resident).table, config)
    for n in range(len(samples)):
        mapper.observe(n)
        if n >= config.lag:
            mapper.map_keyframe(n - config.lag)
    for n in range(len(samples) - config.lag, len(samples)):
        mapper.map_keyframe(n)
    return mapper


@pytest.fixture(scope="module")
def mapper(sequence) -> Mapper:
    """A map of the whole sequence, not yet refined."""
    return build(sequence[0])


def copy_of(mapper: Mapper) -> Mapper:
    """Another mapper of the same keyframes with a map of its own."""
    mapper.settle()
    return Mapper(mapper.keyframes, MAPPING, table=copied(mapper.table))


def depth_error(mapper: Mapper, truth: list[np.ndarray]) -> float:
    """Median error in cm of the rendered depth over all keyframes."""
    renders = mapper.renders()
    errors = [
        100 * np.abs(r.depth.numpy() - d)[(r.depth.numpy() > 0) & (d > 0)]
        for r, d in zip(renders, truth, strict=True)
    ]
    return float(np.median(np.concatenate(errors)))


def test_the_map_renders_the_true_depth(mapper, sequence):
    assert depth_error(mapper, sequence[1]) < 3.0
    covered = np.mean([(r.depth > 0).float().mean() for r in mapper.renders()])
    assert covered > 0.95
    assert 500 < len(mapper.table.disks) < 12_000


def test_training_and_refining_make_it_better(mapper, sequence):
    keyframes, truth = sequence
    untrained = build(keyframes, replace(MAPPING, iterations=0))
    before = depth_error(untrained, truth)
    online = depth_error(mapper, truth)
    trained = copy_of(mapper)
    trained.refine()
    final = depth_error(trained, truth)
    assert online < before
    assert final < 0.97 * online


def test_a_short_training_looks_only_where_it_trained(mapper, monkeypatch):
    """Of more views than steps those that were trained; else all, each time."""
    mapper = copy_of(mapper)
    filled: list[int] = []
    monkeypatch.setattr(mapper.growth, "insert", lambda view, confidence: filled.append(view.id))
    mapper.train(6)
    assert [filled.count(i) for i in filled[:2]] == [2, 2]  # after two steps, and after four
    assert len(filled) == 2 + 4
    filled.clear()
    mapper.train(9)
    assert filled == 2 * list(range(9))


def test_the_first_part_of_a_training_goes_at_half_the_resolution(mapper, monkeypatch):
    mapper = copy_of(mapper)
    steps: list[bool] = []

    def noted(batches, factors, coarse):
        steps.extend([coarse] * len(batches))

    monkeypatch.setattr(mapper.trainer, "coarse_part", 0.4)
    monkeypatch.setattr(mapper.trainer, "train", noted)
    mapper.train(30)
    assert steps == [True] * 12 + [False] * 18


@pytest.mark.long
def test_same_seed_same_map(sequence):
    first, second = (build(sequence[0][:6]) for _ in range(2))
    both = zip(first.table.disks.parameters, second.table.disks.parameters, strict=True)
    assert all(torch.equal(a, b) for a, b in both)


def test_disturbed_poses_are_drawn_back_by_the_map(mapper, sequence):
    """A centimetre and a third of a degree of error shrink; the earliest pose is not touched."""
    true = {n: k.T_cw for n, k in enumerate(sequence[0])}
    active = [3, 4, 5, 6]
    g = torch.Generator().manual_seed(1)
    for i in active[1:]:
        xi = torch.randn(6, dtype=torch.float64, generator=g)
        xi[:3] *= 0.008
        xi[3:] *= 0.004
        mapper.keyframes[i].T_cw = retract(xi, true[i])
    start = {i: mapper.views[i].T_cw for i in active}
    config, mapper.config = mapper.config, replace(MAPPING, pose_iterations=40, pose_lr=6e-4)
    mapper.refine_poses(active)
    mapper.config = config
    poses = {i: mapper.keyframes[i].T_cw for i in active}

    def error(T: dict[int, torch.Tensor]) -> float:
        centres = [
            torch.linalg.inv(T[i])[:3, 3] - torch.linalg.inv(true[i])[:3, 3] for i in active[1:]
        ]
        return 100 * float(torch.stack(centres).norm(dim=1).mean())

    assert torch.equal(poses[3], true[3])
    assert error(poses) < 0.6 * error(start)
    for i in active:
        mapper.keyframes[i].T_cw = true[i]


def correct(mapper: Mapper, correction: PoseCorrection) -> None:
    """Let the keyframes take over a correction, and the map follow."""
    segment = mapper.keyframes.set_of[0]
    segment.correct(correction)
    (made,) = segment.take_corrections()
    mapper.correct(made)


def test_a_rigid_correction_moves_map_and_views_together(sequence):
    keyframes, truth = sequence
    mapper = build(keyframes[:6])
    before = depth_error(mapper, truth[:6])
    G = se3_exp(torch.tensor([0.5, -0.3, 0.2, 0.3, 0.5, -0.2], dtype=torch.float64))
    old = {n: k.T_cw for n, k in enumerate(keyframes[:6])}
    new = {i: T @ se3_inverse(G) for i, T in old.items()}
    correct(mapper, PoseCorrection(old, new, dict.fromkeys(old, 1.0)))
    assert depth_error(mapper, truth[:6]) == pytest.approx(before, abs=0.02)


@pytest.mark.long
def test_mapping_goes_on_in_corrected_units(sequence):
    """Half-way the world turns, moves and shrinks to nine tenths; the map hardly differs after."""
    keyframes, truth = sequence
    factor = 0.9
    G = se3_exp(torch.tensor([0.5, -0.3, 0.2, 0.3, 0.5, -0.2], dtype=torch.float64))

    def corrected(keyframe: Sample) -> Sample:
        T = keyframe.T_cw @ se3_inverse(G)
        T[:3, 3] *= factor
        return replace(keyframe, T_cw=T, inverse_depth=keyframe.inverse_depth / factor)

    plain, mapper = build(keyframes), build(keyframes[:6])
    old = {n: k.T_cw for n, k in enumerate(keyframes[:6])}
    moved = [corrected(k) for k in keyframes]
    new = {n: k.T_cw for n, k in enumerate(moved[:6])}
    depths = {i: v.dense.depth.clone() for i, v in mapper.views.items()}
    correct(mapper, PoseCorrection(old, new, dict.fromkeys(old, 1 / factor)))
    for i, view in mapper.views.items():
        assert (view.dense.depth / depths[i]).numpy() == pytest.approx(factor, rel=1e-5)
        assert (view.T_cw - new[i]).abs().max() == 0
        assert view.rendered_depth is None
    segment = mapper.keyframes.set_of[0]
    added = [add(segment, sample).id for sample in moved[6:]]
    for n in added:
        mapper.observe(n)
    for n in added:
        mapper.map_keyframe(n)
    renders = [r.depth.numpy() / factor for r in mapper.renders()]
    errors = [np.abs(r - d)[(r > 0) & (d > 0)] for r, d in zip(renders, truth, strict=True)]
    median = 100 * float(np.median(np.concatenate(errors)))
    assert median == pytest.approx(depth_error(plain, truth), rel=0.15)
    assert len(mapper.table.disks) == pytest.approx(len(plain.table.disks), rel=0.05)


def test_a_floater_is_carved_and_the_surface_stays(mapper):
    mapper = copy_of(mapper)
    count = len(mapper.table.disks)
    view = mapper.views[2]
    T_wc = view.T_wc.float()
    floater = (torch.tensor([[0.0, 0.0, 0.6]]) @ T_wc[:3, :3].T + T_wc[:3, 3]).expand(5, 3)
    parts = mapper.table.disks.parameters
    new = type(parts)(floater, *(p.detach()[:5] for p in parts[1:]))
    mapper.table.disks.append(new, view.id)
    mapper.growth.prune(list(mapper.views.values()))
    left = mapper.table.disks.position.detach()
    assert not ((left - floater[0]).norm(dim=1) < 1e-3).any()
    assert len(mapper.table.disks) > 0.97 * count


def test_windows_hold_the_newest_and_draw_older_ones():
    random = np.random.default_rng(0)
    config = replace(MAPPING, window=4, views_per_step=3)
    drawn = draw_views(list(range(20)), 60, config, random)
    assert all(19 in views for views in drawn[::3])
    assert all(len(views) <= 3 for views in drawn)
    older = {i for views in drawn for i in views if i < 16}
    assert len(older) == 2
    often = [draw_views(list(range(20)), 6, config, random) for _ in range(20)]
    assert len({i for drawn in often for views in drawn for i in views if i < 16}) > 8
    (whole,) = draw_views(list(range(20)), 1, replace(config, views_per_step=0), random)
    assert len(whole) == 6
    assert set(range(16, 20)) <= set(whole)


@pytest.mark.long
def test_parked_views_change_nothing(sequence):
    """With next to no keyframe in memory the same map comes out, bit by bit."""
    keyframes, _ = sequence
    config = replace(MAPPING, iterations=3, final_iterations=6, final_depth=True)
    maps = []
    for resident in (128, 2):
        mapper = build(keyframes[:7], config, resident)
        mapper.refine()
        maps.append(mapper)
    held, parked = maps
    assert sum(i in held.views.arrays.loaded for i in held.views) == 7
    assert sum(i in parked.views.arrays.loaded for i in parked.views) == 2
    for a, b in zip(held.table.disks.parameters, parked.table.disks.parameters, strict=True):
        assert torch.equal(a, b)
    for i in held.table.mapped:
        a, b = held.views[i], parked.views[i]
        assert torch.equal(a.dense.depth, b.dense.depth)
        assert torch.equal(a.constants.edge, b.constants.edge)
        assert torch.equal(a.constants.prior_depth, b.constants.prior_depth)
        assert torch.equal(a.photo.grey, b.photo.grey)
        assert (a.typical_depth, a.row.partners) == (b.typical_depth, b.row.partners)
        if a.rendered_depth is not None:
            assert torch.equal(a.rendered_depth, b.rendered_depth)
    parked.keyframes[0].rescale(2.0)
    torch.testing.assert_close(parked.views[0].dense.depth, 2 * held.views[0].dense.depth)
    assert parked.views[0].typical_depth == pytest.approx(2 * held.views[0].typical_depth)
