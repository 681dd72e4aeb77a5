"""Loops are verified by features, depth and flow; look-alikes of another shape are refused."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from geogs.config import LoopConfig
from geogs.geometry.lie import se3_exp, se3_inverse, so3_log
from geogs.loop import detect, search
from geogs.loop.dense_check import dense_check
from geogs.loop.detect import LoopDetector
from geogs.loop.orb_features import orb_features
from geogs.loop.verification import FeatureView, TwoViewVerifier
from geogs.world.keyframes import KeyframeSet
from geogs.world.loops import ImageFeatures
from geogs_synth.raycast.raycaster import RenderedView
from lit_rooms import lit_room
from loop_scenes import CAMERA, keyframes, orbit, room_views, stretched, views

LAP = 18
AGAIN = 3
"""Views after the lap: the first three places, 4 degrees aside."""
DRIFT = torch.tensor([0.6, -0.3, 1.5, 0.3, 0.8, -0.2], dtype=torch.float64)
"""So far off that poses propose no loop."""


@pytest.fixture(scope="module")
def path() -> tuple[list[RenderedView], list[np.ndarray]]:
    """Once around a room and a little on."""
    scene = lit_room(3).scene
    poses = orbit(scene, LAP) + orbit(scene, LAP, np.radians(4))[:AGAIN]
    return room_views(3, poses), poses


@pytest.fixture
def walk(path):
    """Keyframes of the path with true depth and poses."""
    return keyframes(*path)


def _relative(store: KeyframeSet, first: int, second: int) -> torch.Tensor:
    return store[second].T_cw @ se3_inverse(store[first].T_cw)


def _suppress(monkeypatch: pytest.MonkeyPatch, keyframes: int) -> None:
    for module in (search, detect):
        monkeypatch.setattr(module, "SUPPRESSION", keyframes)


def _turn(A: torch.Tensor, B: torch.Tensor) -> float:
    return math.degrees(float(so3_log(A[:3, :3] @ B[:3, :3].mT).norm()))


def _drift(store: KeyframeSet, ids: range) -> None:
    for id in ids:
        store[id].T_cw = se3_exp(DRIFT) @ store[id].T_cw


def _scale_depth(store: KeyframeSet, id: int, factor: float) -> None:
    store[id].inverse_depth = store[id].inverse_depth / factor


def _views_of(store: KeyframeSet, *ids: int) -> list[FeatureView]:
    return [_depth_view(store, k, orb_features(store[k].image)) for k in ids]


def _depth_view(store: KeyframeSet, id: int, features: ImageFeatures) -> FeatureView:
    state = store[id]
    return FeatureView.of(store.grid, state.inverse_depth, state.information, features)


def test_features_give_pose_and_scale(walk):
    store, _ = walk
    _scale_depth(store, LAP, 1.2)
    view = TwoViewVerifier(CAMERA).verify(*_views_of(store, 0, LAP))
    assert view.accepted, view.reason
    assert view.is_metric
    true = _relative(store, 0, LAP)
    assert _turn(view.T_ji, true) < 0.2
    assert float((view.T_ji[:3, 3] - true[:3, 3]).norm()) < 0.01
    assert view.scale == pytest.approx(1.2, rel=0.02)


def test_without_depth_the_pose_has_no_scale(walk):
    store, _ = walk
    first, second = (FeatureView(v.features) for v in _views_of(store, 0, 1))
    view = TwoViewVerifier(CAMERA).verify(first, second)
    assert view.accepted, view.reason
    assert not view.is_metric
    assert view.scale is None
    true = _relative(store, 0, 1)
    assert _turn(view.T_ji, true) < 2.0
    direction = true[:3, 3] / true[:3, 3].norm()
    # Little parallax beside the rotation: the direction is weak.
    assert float(view.T_ji[:3, 3] @ direction) > math.cos(math.radians(25))


def test_views_of_other_places_are_refused(walk):
    store, _ = walk
    verifier = TwoViewVerifier(CAMERA)
    far = [verifier.verify(*_views_of(store, k, k + LAP // 2)) for k in range(0, 8, 2)]
    assert not any(v.accepted for v in far)
    assert all(v.reason for v in far)


def test_one_picture_in_both_views_is_not_enough(walk):
    store, _ = walk
    first, second = _views_of(store, 0, LAP)
    a = first.features
    inside = (a.pixels[:, 0] > 96) & (a.pixels[:, 0] < 180) & (a.pixels[:, 1] < 140)
    keep = type(a)(a.pixels[inside], a.descriptors[inside])
    view = TwoViewVerifier(CAMERA).verify(FeatureView(keep, first.depth[inside]), second)
    assert not view.accepted


def test_flow_confirms_and_sharpens_a_pose(walk):
    store, operator = walk
    true = _relative(store, 0, LAP)
    off = se3_exp(torch.tensor([0.02, -0.01, 0.02, 0.005, 0.01, -0.005], dtype=torch.float64))
    check = dense_check(store.grid, operator, store[0], store[LAP], off @ true)
    assert check.accepted, check.reason
    assert _turn(check.T_ji, true) < 0.05
    assert float((check.T_ji[:3, 3] - true[:3, 3]).norm()) < 0.005
    assert check.scale == pytest.approx(1.0, abs=0.01)


def test_flow_refuses_a_pose_from_nowhere(walk):
    store, operator = walk
    check = dense_check(store.grid, operator, store[0], store[6], _relative(store, 0, LAP))
    assert not check.accepted
    assert check.reason


def test_looks_close_a_loop_that_drift_hides(walk, monkeypatch):
    _suppress(monkeypatch, 1)
    store, operator = walk
    true = {k: _relative(store, k - LAP, k) for k in store.ids[LAP:]}
    _drift(store, range(LAP, LAP + AGAIN))
    detector = LoopDetector(store.table, operator, LoopConfig(min_gap=10))
    loops = [x for k in store.ids for x in detector.update([k])] + [*detector.update([], True)]
    loops = [loop for loop in loops if loop.second >= LAP]
    assert {(0, LAP), (1, LAP + 1)} <= {(loop.first, loop.second) for loop in loops}
    for loop in loops:
        assert loop.cause == "appearance"
        if loop.second - loop.first == LAP:
            assert _turn(loop.T_ji, true[loop.second]) < 0.2
            assert float((loop.T_ji - true[loop.second])[:3, 3].norm()) < 0.01


def test_poses_close_a_loop_without_features(walk, monkeypatch):
    store, operator = walk
    detector = LoopDetector(store.table, operator, LoopConfig(min_gap=10))
    monkeypatch.setattr(search, "orb_features", partial(orb_features, most=8))
    loops = detector.update(store.ids, is_last=True)
    assert loops
    assert all(loop.cause == "geometry" and loop.inliers == 0 for loop in loops)
    for loop in loops:
        true = _relative(store, loop.first, loop.second)
        assert _turn(loop.T_ji, true) < 0.2


def test_a_loop_as_a_similarity_takes_depth_to_depth(walk, monkeypatch):
    _suppress(monkeypatch, 0)
    store, operator = walk
    _scale_depth(store, LAP, 1.2)
    detector = LoopDetector(store.table, operator, LoopConfig(min_gap=10))
    detector.update(store.ids[: LAP + 1], is_last=True)
    loop = next(x for x in detector.table.loops if x.second == LAP)
    assert loop.scale == pytest.approx(1.2, rel=0.02)
    # The points before the first camera lie at 1.2 times their depth before the second.
    there = loop.S_ji[:3, :3] @ torch.tensor([0.0, 0, 2], dtype=torch.float64) + loop.S_ji[:3, 3]
    true = _relative(store, loop.first, LAP)
    exact = true[:3, :3] @ torch.tensor([0.0, 0, 2], dtype=torch.float64) + true[:3, 3]
    assert torch.allclose(there, 1.2 * exact, atol=0.06)


def test_close_pairs_suppress_each_other(walk):
    store, operator = walk
    detector = LoopDetector(store.table, operator, LoopConfig(min_gap=10))
    detector.update(store.ids, is_last=True)
    pairs = [(loop.first, loop.second) for loop in detector.table.loops]
    assert pairs
    for n, (a, b) in enumerate(pairs):
        assert b - a > 10
        assert all(abs(a - c) + abs(b - d) > search.SUPPRESSION for c, d in pairs[:n])


def test_near_what_is_settled_nothing_is_looked_at(walk, monkeypatch):
    store, operator = walk
    checked = []
    check = detect.dense_check
    monkeypatch.setattr(
        detect, "dense_check", lambda *of: checked.append((of[2].id, of[3].id)) or check(*of)
    )
    detector = LoopDetector(store.table, operator, LoopConfig(min_gap=10))
    assert detector.update(store.ids[: LAP + 1], is_last=True, settled=[(0, LAP)]) == ()
    assert checked == []
    assert detector.update(store.ids[LAP + 1 : LAP + 2], is_last=True)
    assert checked


def test_what_two_loops_say_together_is_not_asked_again(walk, monkeypatch):
    _suppress(monkeypatch, 1)
    store, operator = walk
    detector = LoopDetector(store.table, operator, LoopConfig(min_gap=10))
    first = detector.update(store.ids, is_last=True)
    assert {(loop.first % LAP, loop.second % LAP) for loop in first} & {(0, 0), (0, 1), (1, 1)}
    implied = detector._is_implied(0, [replace(first[0], first=first[0].second)], ())
    assert implied == (first[0].first <= 1)


def test_update_is_deterministic(path):
    def run() -> list[tuple[int, int, float]]:
        store, operator = keyframes(*path)
        detector = LoopDetector(store.table, operator, LoopConfig(min_gap=10))
        loops = [x for k in store.ids for x in detector.update([k])] + [*detector.update([], True)]
        return [(x.first, x.second, float(x.T_ji.sum())) for x in loops]

    assert run() == run()


@pytest.mark.long
def test_a_room_of_another_shape_with_the_same_pictures_closes_no_loop(path):
    seen, poses = path
    other = stretched(lit_room(3).scene, 1.35)
    twins = orbit(other, LAP, np.radians(4))[:AGAIN]
    store, operator = keyframes(seen[:LAP] + views(other, twins), poses[:LAP] + twins)
    _drift(store, range(LAP, LAP + AGAIN))
    detector = LoopDetector(store.table, operator, LoopConfig(min_gap=10))
    # The lap itself closes where its end meets its beginning.
    assert [loop for loop in detector.update(store.ids, True) if loop.second >= LAP] == []


def test_blank_keyframes_close_nothing(path):
    seen, poses = path
    store, operator = keyframes(seen[:14], poses[:14])
    for id in (0, 12, 13):
        blank = np.full_like(store[id].image, 120)
        store.table.arrays.put("image", id, blank, recent=True)
        store[id].own_encoded = operator.encode(blank)
        store[id].information = torch.zeros_like(store[id].information)
    detector = LoopDetector(store.table, operator, LoopConfig(min_gap=5))
    assert detector.update([0, 12, 13], is_last=True) == ()
