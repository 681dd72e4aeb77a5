"""Moving the map after a correction: exactness, coherence, scale, and the strategies apart."""

from dataclasses import replace

import pytest
import torch

from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse, sim3_exp, sim3_inverse, sim3_log, sim3_scale
from geogs.mapping.map_update import (
    CovisibleKeyframe,
    Strategy,
    agreement,
    anchor_transforms,
    apply_each,
    blended_similarities,
    plan_update,
    smoothed,
)
from geogs.types import PoseCorrection

F64 = torch.float64
STRATEGIES: tuple[Strategy, ...] = ("blended", "coherent", "per_keyframe")


def poses(n: int, seed: int = 0) -> dict[int, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {3 * i: se3_exp(torch.randn(6, dtype=F64, generator=g)) for i in range(n)}


def wall(n: int = 4000, seed: int = 1) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    x = torch.rand(n, 3, dtype=F64, generator=g) * torch.tensor([6.0, 3.0, 0.0], dtype=F64)
    return x + torch.tensor([0.0, 0.0, 2.0], dtype=F64)


def corrected_by(S: torch.Tensor, before: dict[int, torch.Tensor]) -> PoseCorrection:
    """The correction that moves the whole world by one similarity."""
    scale = float(sim3_scale(S))
    after = {}
    for i, T in before.items():
        moved = T @ sim3_inverse(S)
        moved[:3] *= scale
        moved[:3, :3] /= sim3_scale(moved)
        after[i] = moved
    return PoseCorrection(before, after, dict.fromkeys(before, 1 / scale))


@pytest.mark.parametrize("size", [0.0, 0.4, 2.0])
def test_one_similarity_of_the_world_is_followed_exactly_by_every_strategy(size):
    S = sim3_exp(size * torch.tensor([0.9, -0.6, 1.5, 0.6, 0.3, -1.2, 0.35], dtype=F64))
    correction = corrected_by(S, poses(5))
    x = wall()
    anchor = torch.randint(0, 5, (len(x),), generator=torch.Generator().manual_seed(0)) * 3
    expected = x @ S[:3, :3].T + S[:3, 3]
    seen = [flat(3 * i, correction) for i in range(5)]
    for strategy in STRATEGIES:
        update = plan_update(x, anchor, correction, strategy, seen)
        assert (apply_each(update, x) - expected).abs().max() < 1e-8
        assert (update - S).abs().max() < 1e-8


def test_scale_acts_about_the_new_camera_centre_not_the_world_origin():
    """With T' = (R, t/s) a point keeps its pixel and its camera-frame depth is divided by s."""
    T = se3_exp(torch.tensor([1.0, -2.0, 0.5, 0.3, 0.8, -0.1], dtype=F64))
    s = 1.25
    after = T.clone()
    after[:3, 3] = torch.tensor([4.0, 1.0, -3.0], dtype=F64)
    _, S = anchor_transforms(PoseCorrection({7: T}, {7: after}, {7: s}))
    x = wall(50)
    moved = apply_each(S.expand(50, 4, 4), x)
    camera_before = x @ T[:3, :3].T + T[:3, 3]
    camera_after = moved @ after[:3, :3].T + after[:3, 3]
    assert (camera_after - camera_before / s).abs().max() < 1e-12


CAMERA = Camera(fx=60.0, fy=60.0, cx=59.5, cy=49.5, width=120, height=100)
COUNT = 21


def beside(i: float) -> torch.Tensor:
    """World to camera along a wall at z = 2, six units long, looking at it."""
    T_wc = torch.eye(4, dtype=F64)
    T_wc[0, 3], T_wc[1, 3] = 6.0 * i / (COUNT - 1), 1.5
    return se3_inverse(T_wc)


def flat(i: int, correction: PoseCorrection, depth: float = 2.0) -> CovisibleKeyframe:
    """A keyframe that sees a surface square to it."""
    size = (CAMERA.height, CAMERA.width)
    return CovisibleKeyframe(
        i, CAMERA, correction.before[i], torch.full(size, depth), torch.full(size, 0.9)
    )


def drift() -> PoseCorrection:
    """Lengths along the wall shrink from keyframe to keyframe, to nine tenths, and it bends."""
    before, after, scale = {}, {}, {}
    for i in range(COUNT):
        share = i / (COUNT - 1)
        before[i] = beside(i)
        bend = torch.tensor([0, 0, 0.08 * share**2, 0, 0.02 * share, 0, 0], dtype=F64)
        bend[6] = -0.1 * share
        moved = corrected_by(sim3_exp(bend), {i: before[i]})
        after[i], scale[i] = moved.after[i], moved.scale[i]
    return PoseCorrection(before, after, scale)


def scattered_anchors(x: torch.Tensor) -> torch.Tensor:
    """Neighbouring disks were made by different keyframes that all saw them."""
    g = torch.Generator().manual_seed(4)
    noisy = x[:, 0] / 6 * (COUNT - 1) + 3 * torch.randn(len(x), generator=g, dtype=F64)
    return noisy.round().clamp(0, COUNT - 1).long()


def tearing(x: torch.Tensor, moved: torch.Tensor) -> float:
    """95th percentile of |log(distance after / before)| between near points, less the growth."""
    d, e = torch.cdist(x[:1500], x[:1500]), torch.cdist(moved[:1500], moved[:1500])
    near = (d < 0.15) & (d > 1e-6)
    ratio = (e[near] / d[near]).log()
    return float((ratio - ratio.median()).abs().quantile(0.95))


def test_a_drift_along_a_corridor_is_followed_without_tearing():
    correction, x = drift(), wall()
    anchor = scattered_anchors(x)
    seen = [flat(i, correction) for i in correction.before]
    moved = {s: apply_each(plan_update(x, anchor, correction, s, seen), x) for s in STRATEGIES}
    assert tearing(x, moved["blended"]) < 0.1 * tearing(x, moved["per_keyframe"])
    assert tearing(x, moved["coherent"]) < 1e-9
    # The targets: where the keyframe that looks straight at a disk takes it.
    straight = (x[:, 0] / 6 * (COUNT - 1)).round().long()
    target = apply_each(plan_update(x, straight, correction, "per_keyframe"), x)
    error = {s: float((m - target).norm(dim=1).mean()) for s, m in moved.items()}
    correction_size = float((target - x).norm(dim=1).mean())
    assert error["blended"] < 0.1 * correction_size
    assert error["blended"] < 0.5 * min(error["coherent"], error["per_keyframe"])


def test_without_witnesses_neighbours_still_move_alike():
    correction, x = drift(), wall()
    anchor = scattered_anchors(x)
    torn = apply_each(plan_update(x, anchor, correction, "per_keyframe"), x)
    whole = apply_each(plan_update(x, anchor, correction, "blended"), x)
    assert tearing(x, whole) < 0.2 * tearing(x, torn)


def test_each_layer_of_a_doubled_surface_goes_with_the_keyframes_that_see_it():
    """The second visit saw the wall 0.2 nearer; the correction puts both at the same place."""
    first, second = {0: beside(3.0), 1: beside(6.0)}, {50: beside(3.0), 51: beside(6.0)}
    before = first | second
    shift = torch.tensor([0, 0, 0.2, 0, 0, 0], dtype=F64)
    after = first | {i: T @ se3_inverse(se3_exp(shift)) for i, T in second.items()}
    correction = PoseCorrection(before, after, {})
    x = wall(8000)
    x = x[((x[:, :2] - 1.5).abs() < torch.tensor([0.5, 1.0])).all(1)]
    x = torch.cat([x, x - torch.tensor([0.0, 0.0, 0.2], dtype=F64)])
    visit = (torch.arange(len(x)) >= len(x) // 2).long() * 50
    seen = [flat(i, correction, 2.0 if i < 50 else 1.8) for i in before]
    # A tenth has the wrong anchor: trained onto the other layer by the other visit's keyframes.
    anchor = torch.where(torch.arange(len(x)) % 10 == 0, 50 - visit, visit)
    depth = {
        s: apply_each(plan_update(x, anchor, correction, s, seen), x)[:, 2] for s in STRATEGIES
    }
    assert (depth["blended"] - 2.0).abs().max() < 0.03
    assert (depth["per_keyframe"] - 2.0).abs().max() > 0.19
    # One similarity for the second visit's disks: the tenth that lies on the other layer is led
    # astray, as by its anchor.
    assert (depth["coherent"] - 2.0).abs().median() < 0.01
    assert (depth["coherent"] - 2.0).abs().max() > 0.19


def test_agreement_is_of_those_on_the_surface_within_the_image():
    keyframe = flat(0, drift())
    x = torch.tensor(
        [[0, 1.5, 2], [0, 1.5, 2.06], [0, 1.5, 1.5], [0, 1.5, -2], [9, 1.5, 2], [1.9, 1.5, 2]],
        dtype=F64,
    )
    confidence = agreement(x, keyframe)
    expected = torch.tensor([0.9, 0.9 * torch.exp(torch.tensor(-0.5)), 0, 0, 0], dtype=F64)
    torch.testing.assert_close(confidence[:5], expected, rtol=1e-5, atol=1e-5)
    assert 0 < confidence[5] < 0.9


def test_the_blend_is_the_weighted_mean_in_the_lie_algebra():
    """A lone disk: witnesses and anchor, written out."""
    correction = drift()
    x = torch.tensor([[1.4, 1.2, 2.02]], dtype=F64)
    seen = [flat(i, correction) for i in range(0, COUNT, 2)]
    _, S = anchor_transforms(correction)
    reference = sim3_exp(torch.tensor([0.2, 0.1, 0, 0.03, 0, 0.1, -0.05], dtype=F64))
    heard = zip(seen, range(0, COUNT, 2), strict=True)
    got = blended_similarities(x, S[5:6], reference, S, heard)
    total, weight = 0.1 * sim3_log(S[5] @ sim3_inverse(reference)), 0.1
    for w, S_i in zip(seen, S[::2], strict=True):
        say = float(agreement(x, w)[0])
        total, weight = total + say * sim3_log(S_i @ sim3_inverse(reference)), weight + say
    torch.testing.assert_close(got[0], sim3_exp(total / weight) @ reference, rtol=0, atol=1e-12)


def test_the_blend_does_not_depend_on_the_order_or_the_origin():
    correction, x = drift(), wall(800)
    anchor = scattered_anchors(x)
    seen = [flat(i, correction) for i in correction.before]
    S = plan_update(x, anchor, correction, "blended", seen)
    order = torch.randperm(len(x), generator=torch.Generator().manual_seed(0))
    mixed = plan_update(x[order], anchor[order], correction, "blended", seen[::-1])
    assert (mixed - S[order]).abs().max() < 1e-9
    W = se3_exp(torch.tensor([40.0, -7.0, 3.0, 0.4, 1.0, -0.3], dtype=F64))
    back = se3_inverse(W)
    elsewhere = PoseCorrection(
        {i: T @ back for i, T in correction.before.items()},
        {i: T @ back for i, T in correction.after.items()},
        correction.scale,
    )
    seen = [replace(w, T_cw=w.T_cw @ back) for w in seen]
    there = plan_update(x @ W[:3, :3].T + W[:3, 3], anchor, elsewhere, "blended", seen)
    assert (back @ there @ W - S).abs().max() < 1e-7


def test_smoothing_keeps_what_is_the_same_and_parts_what_has_to():
    x = wall(600)
    even = torch.tensor([0.1, -0.2, 0.3, 0.02, 0.01, -0.03, 0.04], dtype=F64)
    assert (smoothed(x, x, even.expand(len(x), 7)) - even).abs().max() < 1e-12
    step = torch.zeros(len(x), 7, dtype=F64)
    step[x[:, 0] > 3, 2] = 1.0
    assert (smoothed(x, x, step) - step).abs().max() < 1e-6


def test_disks_of_culled_keyframes_follow_the_nearest_in_time():
    before = poses(3)
    after = {i: T.clone() for i, T in before.items()}
    after[6][:3, 3] += 1.0
    update = plan_update(
        wall(2), torch.tensor([1, 5]), PoseCorrection(before, after, {}), "per_keyframe"
    )
    assert (update[0] - torch.eye(4, dtype=F64)).abs().max() < 1e-12
    assert (update[1] - torch.eye(4, dtype=F64)).abs().max() > 0.1


def part_moved(bend: float) -> tuple[torch.Tensor, torch.Tensor, PoseCorrection, torch.Tensor]:
    """Disks, anchors and a correction of the last keyframes alone, by one similarity or bent."""
    before = {i: beside(i) for i in range(COUNT)}
    S = sim3_exp(torch.tensor([0.1, -0.05, 0.08, 0.02, -0.03, 0.04, 0.06], dtype=F64))
    after, scale = dict(before), {}
    for i in range(12, COUNT):
        away = torch.tensor([0, 0, bend * (-1) ** i, 0, 0, 0, 0], dtype=F64)
        one = corrected_by(sim3_exp(away) @ S, {i: before[i]})
        after[i], scale[i] = one.after[i], one.scale[i]
    x = wall(2000)
    return x, scattered_anchors(x), PoseCorrection(before, after, scale), S


def test_coherent_moves_the_revisited_by_one_similarity_and_leaves_the_others():
    x, anchor, correction, S = part_moved(0.0)
    update = plan_update(x, anchor, correction, "coherent")
    expected = torch.where((anchor >= 12)[:, None, None], S, torch.eye(4, dtype=F64))
    assert (update - expected).abs().max() < 1e-8
    # A little bend is evened out among the revisited.
    x, anchor, correction, _ = part_moved(0.02)
    update = plan_update(x, anchor, correction, "coherent")
    moved = update[anchor >= 12]
    assert (moved - moved[0]).abs().max() == 0
    assert (update[anchor < 12] - torch.eye(4, dtype=F64)).abs().max() == 0


def test_coherent_goes_with_the_anchors_where_a_part_moves_in_no_one_way():
    x, anchor, correction, _ = part_moved(0.5)
    update = plan_update(x, anchor, correction, "coherent")
    each = plan_update(x, anchor, correction, "per_keyframe")
    assert torch.equal(update, each)
    # Where all of the map is revisited the paper's one similarity stays.
    late = anchor >= 12
    update = plan_update(x[late], anchor[late], correction, "coherent")
    assert (update - update[0]).abs().max() == 0
    own = plan_update(x[late], anchor[late], correction, "per_keyframe")
    missed = (apply_each(own, x[late]) - apply_each(update, x[late])).norm(dim=1)
    assert float(missed.square().mean().sqrt()) > 0.3


def test_after_an_adjustment_of_all_everything_goes_by_one_similarity():
    x, anchor, correction, _ = part_moved(0.5)
    together = replace(correction, of_all=True)
    update = plan_update(x, anchor, together, "coherent")
    assert (update - update[0]).abs().max() == 0
    own = plan_update(x, anchor, together, "per_keyframe")
    assert (own - update).abs().max() > 0


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_few_disks_and_a_single_keyframe(strategy, count):
    before = {4: poses(1)[0]}
    S = sim3_exp(torch.tensor([0.1, 0.2, -0.1, 0.05, -0.2, 0.1, 0.1], dtype=F64))
    x, anchor = wall(8)[:count], torch.zeros(count, dtype=torch.long)
    update = plan_update(x, anchor, corrected_by(S, before), strategy)
    assert update.shape == (count, 4, 4)
    assert count == 0 or (update - S).abs().max() < 1e-9


def test_witnesses_unknown_to_the_correction_say_nothing():
    correction, x = drift(), wall(300)
    stranger = replace(flat(0, correction), keyframe_id=99)
    with_stranger = plan_update(x, scattered_anchors(x), correction, "blended", [stranger])
    without = plan_update(x, scattered_anchors(x), correction, "blended")
    assert (with_stranger - without).abs().max() == 0
