"""Moving the map after a correction: exactness, coherence, scale, and the two strategies apart."""

import pytest
import torch

from geogs.geometry.lie import se3_exp, se3_inverse, sim3_exp
from geogs.mapping.map_update import anchor_transforms, apply_each, plan_update
from geogs.types import PoseCorrection

F64 = torch.float64


def poses(n: int, seed: int = 0) -> dict[int, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {3 * i: se3_exp(torch.randn(6, dtype=F64, generator=g)) for i in range(n)}


def wall(n: int = 4000, seed: int = 1) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    x = torch.rand(n, 3, dtype=F64, generator=g) * torch.tensor([6.0, 3.0, 0.0], dtype=F64)
    return x + torch.tensor([0.0, 0.0, 2.0], dtype=F64)


def test_a_rigid_correction_is_followed_exactly_by_both_strategies():
    before = poses(5)
    G = se3_exp(torch.tensor([0.3, -0.2, 0.5, 0.2, 0.1, -0.4], dtype=F64))
    after = {i: T @ se3_inverse(G) for i, T in before.items()}
    correction = PoseCorrection(before, after, dict.fromkeys(before, 1.0))
    x = wall()
    anchor = torch.randint(0, 5, (len(x),), generator=torch.Generator().manual_seed(0)) * 3
    expected = x @ G[:3, :3].T + G[:3, 3]
    for strategy in ("coherent", "per_keyframe"):
        update = plan_update(x, anchor, correction, strategy)
        assert (apply_each(update.transform, x) - expected).abs().max() < 1e-9
        assert update.residual < 1e-9
    assert update.correction == pytest.approx(
        float((expected - x).norm(dim=1).square().mean().sqrt())
    )


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


def drift(count: int = 21) -> tuple[PoseCorrection, torch.Tensor]:
    """Cameras along a wall whose trajectory bends: no single Sim(3) describes the correction."""
    ids = list(range(count))
    before, after = {}, {}
    for i in ids:
        T_wc = torch.eye(4, dtype=F64)
        T_wc[0, 3] = 6.0 * i / (count - 1)
        bend = se3_exp(torch.tensor([0, 0, 0.02 * (i / 10) ** 2, 0, 0.01 * i / 10, 0], dtype=F64))
        before[i], after[i] = se3_inverse(T_wc), se3_inverse(bend @ T_wc)
    return PoseCorrection(before, after, dict.fromkeys(ids, 1.0)), wall()


def tearing(x: torch.Tensor, moved: torch.Tensor) -> float:
    """Largest change of distance between near points, relative to that distance's scale."""
    d = torch.cdist(x[:1500], x[:1500])
    near = (d < 0.15) & (d > 1e-6)
    return float((torch.cdist(moved[:1500], moved[:1500]) - d)[near].abs().max())


def test_the_coherent_update_follows_a_bend_without_tearing():
    correction, x = drift()
    # Neighbouring disks were made by different keyframes that both saw them.
    g = torch.Generator().manual_seed(4)
    anchor = (x[:, 0] / 6 * 20 + 4 * torch.randn(len(x), generator=g)).round().clamp(0, 20).long()
    torn = plan_update(x, anchor, correction, "per_keyframe")
    whole = plan_update(x, anchor, correction, "coherent")
    moved = apply_each(whole.transform, x)
    assert tearing(x, moved) < 0.1 * tearing(x, apply_each(torn.transform, x))
    # What a smooth field can reach: the correction by position, without the scatter of anchors.
    smooth = plan_update(x, (x[:, 0] / 6 * 20).round().long(), correction, "per_keyframe")
    error = (moved - apply_each(smooth.transform, x)).norm(dim=1)
    assert error.mean() < 0.3 * smooth.correction


def test_one_similarity_is_used_where_it_fits():
    before = poses(4)
    S = sim3_exp(torch.tensor([0.1, 0.2, -0.1, 0.05, -0.2, 0.1, 0.0], dtype=F64))
    after = {i: T @ se3_inverse(S) for i, T in before.items()}
    x = wall(500)
    anchor = torch.arange(500) % 4 * 3
    update = plan_update(x, anchor, PoseCorrection(before, after, {}), "coherent")
    assert (update.transform - update.transform[0]).abs().max() == 0


def test_disks_of_culled_keyframes_follow_the_nearest_in_time():
    before = poses(3)
    after = {i: T.clone() for i, T in before.items()}
    after[6][:3, 3] += 1.0
    update = plan_update(
        wall(2), torch.tensor([1, 5]), PoseCorrection(before, after, {}), "per_keyframe"
    )
    assert (update.transform[0] - torch.eye(4, dtype=F64)).abs().max() < 1e-12
    assert (update.transform[1] - torch.eye(4, dtype=F64)).abs().max() > 0.1


def test_an_empty_map_needs_no_update():
    before = poses(2)
    empty = torch.zeros(0, 3, dtype=F64)
    anchor = torch.zeros(0, dtype=torch.long)
    assert len(plan_update(empty, anchor, PoseCorrection(before, before, {})).transform) == 0
