"""A lens in the adjustment of all keyframes: a walk past a wall, with exact matches of a lens."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from geogs.bundle.projection import project
from geogs.bundle.uncertainty.lens_error import lens_shapes
from geogs.camera.straight_view import StraightView
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.loop.camera import lens as lens_correction
from geogs.loop.global_bundle import global_bundle
from geogs.loop.keyframe_matches import KeyframeMatches
from geogs.tracking.tracker import Tracker
from geogs.types import FlowMatch
from geogs.world.edges import edge_matches
from geogs.world.grid import SampleGrid
from planted_walk import PlantedFlow, centre_error, true_inverse_depth, walked_tracker

CAMERA = Camera(fx=90.0, fy=90.0, cx=63.5, cy=47.5, width=128, height=96)
GRID, COUNT = SampleGrid(CAMERA), 16
LONG = 24
"""Keyframes of a corridor that is long enough to lose its scale."""
BEND = 0.06, -0.1
NOISE = np.random.default_rng(0).integers(1, 255, (CAMERA.height, CAMERA.width), dtype=np.uint8)
"""By which images that are straight are told."""


def forward(turn: float = 0.08, count: int = COUNT) -> Tensor:
    """World to camera: straight on along a corridor, looking about by such an angle."""
    k = np.arange(count)
    xi = np.zeros((count, 6))
    xi[:, 4] = 1.57 + turn * np.sin(0.5 * k)
    T_wc = se3_exp(torch.from_numpy(xi))
    T_wc[:, :3, 3] = torch.from_numpy(np.stack([0.2 * k, 0.03 * np.sin(k), 0.0 * k], -1))
    return se3_inverse(T_wc)


class BentFlow(PlantedFlow):
    """Exact matches between images of a lens."""

    def __init__(
        self,
        T: Tensor,
        bend: tuple[float, float],
        focal: float = 0.0,
        centre: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """``focal``: by which part of what they are taken for the images' focal length is less;
        ``centre``: where their principal point is off, in focal lengths."""
        self.camera = CAMERA.moved(-math.log(1 - focal), *bend, *centre)
        seen_by = SampleGrid(self.camera)
        super().__init__(GRID, T, true_inverse_depth(T, seen_by), 0.0)
        self.rays = seen_by.rays

    def _match(self, source, target) -> FlowMatch:
        i, j = list(source), list(target)
        p = project(self.camera, self.rays, self.T[j] @ se3_inverse(self.T[i]), self.d[i])
        used = p.valid & GRID.inside(p.pixels)
        g = torch.Generator().manual_seed(100 * i[0] + j[0])
        pixels = p.pixels + 0.02 * torch.randn(p.pixels.shape, generator=g)
        weight = torch.where(used, 400.0, 0.0)[..., None].expand(-1, -1, 2).contiguous()
        return FlowMatch(torch.where(used[..., None], pixels, GRID.centre), weight)


def image_of(number: int) -> np.ndarray:
    return np.dstack([np.full_like(NOISE, number), np.zeros_like(NOISE), NOISE])


def tracker_of(
    bend: tuple[float, float],
    focal: float = 0.0,
    centre: tuple[float, float] = (0.0, 0.0),
    count: int = COUNT,
) -> tuple[Tracker, Tensor]:
    T = forward(0.3 if focal else 0.08, count)  # what tells a focal length is rotation
    flow = BentFlow(T, bend, focal, centre)
    return walked_tracker(CAMERA, flow, image_of), T


@pytest.fixture(autouse=True)
def _few_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("geogs.loop.keyframe_matches.PAIRS", 3)


@pytest.mark.system
def test_a_corridor_through_a_lens_that_nobody_told_keeps_its_scale(monkeypatch):
    tracker, truth = tracker_of(BEND, count=LONG)
    believed = lens_correction.EVIDENCE
    monkeypatch.setattr(lens_correction, "EVIDENCE", np.inf)
    global_bundle(tracker)
    bent = centre_error(tracker, truth)
    assert bent > 0.008
    tracker, truth = tracker_of(BEND, count=LONG)
    monkeypatch.setattr(lens_correction, "EVIDENCE", believed)
    global_bundle(tracker)
    assert centre_error(tracker, truth) < 0.2 * bent


def test_the_bend_is_told_as_it_is():
    tracker, _ = tracker_of(BEND)
    ids = list(range(COUNT))
    tracker.map.graph.measure(
        [(a, b) for a in ids for b in range(a + 1, min(a + 4, COUNT))], packed=True
    )
    matches = KeyframeMatches(tracker, ids[1:], ids)
    matches.adjust()
    bend = lens_correction.correct_lens(matches)
    assert bend is not None
    assert (bend.k1, bend.k2) == pytest.approx(BEND, rel=0.1)


def test_deviations_are_the_standard_errors_that_those_before_the_run_are(monkeypatch):
    """Against single standard errors of the same matches."""
    said = []
    for errors in (1.0, lens_correction.STANDARD_ERRORS):
        monkeypatch.setattr(lens_correction, "STANDARD_ERRORS", errors)
        tracker, _ = tracker_of(BEND)
        ids = list(range(COUNT))
        tracker.map.graph.measure([(a, a + 1) for a in ids[:-1]], packed=True)
        matches = KeyframeMatches(tracker, ids[1:], ids)
        matches.adjust()
        said.append(lens_correction.correct_lens(matches))
    one, three = said
    assert (three.k1, three.k2) == (one.k1, one.k2)
    assert three.deviation_k1 == pytest.approx(3 * one.deviation_k1)
    assert three.deviation_k2 == pytest.approx(3 * one.deviation_k2)


@pytest.mark.system
def test_the_end_of_tracking_straightens_images_once():
    tracker, truth = tracker_of(BEND)
    global_bundle(tracker)
    table = tracker.keyframes.table
    assert table.lens is None  # it goes on
    by_a_lens = centre_error(tracker, truth)
    global_bundle(tracker, ends=True)
    lens = table.lens
    assert lens is not None
    assert (lens.k1, lens.k2) == pytest.approx(BEND, rel=0.1)
    assert 0 < lens.deviation_k1 < 0.02
    straight = tracker.keyframes[3].straight_image
    assert np.array_equal(straight, StraightView(CAMERA, CAMERA, lens).image(image_of(3)))
    assert centre_error(tracker, truth) < 1.1 * by_a_lens
    wanted = tracker.map.graph.operator.d
    for keyframe in tracker.keyframes:
        known = keyframe.has_known_depth
        factor = (keyframe.inverse_depth / wanted[keyframe.id])[known]
        assert float((factor / factor.median() - 1).abs().quantile(0.9)) < 0.02
    assert not global_bundle(tracker, ends=True).after
    assert tracker.keyframes[3].straight_image is straight


@pytest.mark.system
def test_matches_stay_those_of_the_images_as_they_were_tracked(monkeypatch):
    tracker, _ = tracker_of(BEND)
    encoded: list[np.ndarray] = []
    encode = tracker.map.operator.encode
    monkeypatch.setattr(
        tracker.keyframes.table, "encode", lambda image: (encoded.append(image), encode(image))[1]
    )
    for id in range(COUNT):
        tracker.keyframes.table.arrays.recent("encoded").drop(id)
    global_bundle(tracker, ends=True)
    assert len(encoded) >= COUNT
    assert all(np.array_equal(image[..., 2], NOISE) for image in encoded)
    camera, matches = tracker.keyframes.grid.camera, tracker.map.graph.edges
    assert (camera.k1, camera.k2) == pytest.approx(BEND, rel=0.1)
    for (i, j), edge in matches.items():
        found, _ = edge_matches(tracker.keyframes.grid, [edge])
        wanted, weight = tracker.map.operator._match([i], [j]).pixels, edge.half_weight > 0
        assert float((found - wanted)[0][weight].abs().max()) < 0.5  # noise of another call


@pytest.mark.system
def test_a_focal_length_that_was_found_without_the_lens_is_found_anew(monkeypatch):
    tracker, truth = tracker_of(BEND, -0.05)
    monkeypatch.setattr(lens_correction, "FOCAL_EVIDENCE", np.inf)
    global_bundle(tracker)
    bent = centre_error(tracker, truth)
    assert tracker.keyframes.grid.camera == CAMERA
    monkeypatch.setattr(lens_correction, "FOCAL_EVIDENCE", 1.0)  # a few keyframes tell little
    tracker, _ = tracker_of(BEND, -0.05)
    global_bundle(tracker, ends=True)
    unsure = tracker.keyframes.table.lens
    assert unsure is not None
    assert unsure.focal == 1  # what matches do not know to 5 % does not overrule what was given
    monkeypatch.setattr(lens_correction, "FOCAL_DOUBT", 1.0)
    tracker, truth = tracker_of(BEND, -0.05)
    global_bundle(tracker, ends=True)
    lens = tracker.keyframes.table.lens
    assert lens is not None
    assert lens.focal == pytest.approx(1 / 1.05, abs=0.01)
    assert abs(lens.focal - 1 / 1.05) < 2 * lens.deviation_focal < 0.04
    assert tracker.keyframes.camera == CAMERA
    assert tracker.keyframes.grid.camera.fx == pytest.approx(CAMERA.fx / 1.05, abs=1.0)
    assert centre_error(tracker, truth) < 0.5 * bent


@pytest.mark.system
def test_a_lens_that_was_but_found_is_asked_for_however_little_is_left(monkeypatch):
    monkeypatch.setattr(lens_correction, "EVIDENCE", np.inf)
    tracker, _ = tracker_of((0.02, -0.03), -0.03)
    global_bundle(tracker, ends=True)
    assert tracker.keyframes.table.lens is None
    tracker, _ = tracker_of((0.02, -0.03), -0.03)
    tracker.keyframes.table.focal_deviation = 0.01
    global_bundle(tracker, ends=True)
    lens = tracker.keyframes.table.lens
    assert lens is not None
    assert lens.focal == pytest.approx(1 / 1.03, abs=0.01)
    assert (lens.k1, lens.k2) == pytest.approx((0.02, -0.03), abs=0.006)


@pytest.mark.system
def test_a_principal_point_is_found_where_nobody_told_of_the_lens():
    """Off by 0.04 focal lengths."""
    bend, centre = (0.02, -0.03), (0.01, -0.04)
    tracker, _ = tracker_of(bend, -0.03, centre)
    global_bundle(tracker, ends=True)
    unsaid = tracker.keyframes.table.lens
    assert unsaid is None or not unsaid.is_off_centre  # somebody said the lens
    tracker, _ = tracker_of(bend, -0.03, centre)
    tracker.keyframes.table.focal_deviation = 0.01
    global_bundle(tracker, ends=True)
    lens = tracker.keyframes.table.lens
    assert lens is not None
    assert (lens.right, lens.down) == pytest.approx(centre, abs=0.006)
    assert 0 < lens.deviation_centre < 0.02
    assert lens.focal == pytest.approx(1 / 1.03, abs=0.012)
    straight = tracker.keyframes[3].straight_image
    assert np.array_equal(straight, StraightView(CAMERA, CAMERA, lens).image(image_of(3)))


@pytest.mark.system
def test_a_principal_point_that_is_hardly_off_stays_the_middle():
    tracker, _ = tracker_of((0.02, -0.03), -0.03, (0.0005, 0.0))
    tracker.keyframes.table.focal_deviation = 0.01
    global_bundle(tracker, ends=True)
    lens = tracker.keyframes.table.lens
    assert lens is not None
    assert not lens.is_off_centre
    assert (lens.k1, lens.k2) == pytest.approx((0.02, -0.03), abs=0.006)


@pytest.mark.system
def test_a_guess_that_is_far_off_is_found_by_all_matches():
    tracker, _ = tracker_of((0.02, -0.03), 0.25)
    tracker.keyframes.table.focal_deviation = 0.35
    global_bundle(tracker, ends=True)
    lens = tracker.keyframes.table.lens
    assert lens is not None
    assert lens.focal == pytest.approx(1 / 0.75, rel=0.05)
    assert abs(lens.focal * 0.75 - 1) < lens.deviation_focal


@pytest.mark.system
@pytest.mark.parametrize("is_found", [pytest.param(True, marks=pytest.mark.long), False])
def test_what_an_open_lens_is_found_by_is_matched_at_half_the_resolution(monkeypatch, is_found):
    tracker, _ = tracker_of((0.02, -0.03), -0.03)
    if not is_found:
        monkeypatch.setattr("geogs.loop.camera.lens.said_of_lens", lambda *_: None)
    matched: list[bool] = []
    measure = tracker.map.operator.measure

    def noted(*pairs, fine, memory):
        matched.append(fine)
        return measure(*pairs, fine=fine, memory=memory)

    monkeypatch.setattr(tracker.map.operator, "measure", noted)
    tracker.keyframes.table.focal_deviation = 0.01
    global_bundle(tracker, ends=True)
    assert (tracker.keyframes.table.lens is not None) is is_found
    assert (matched[0], matched[-1]) == (False, True)
    assert matched == sorted(matched)
    matched.clear()
    tracker, _ = tracker_of((0.02, -0.03), -0.03)
    measure = tracker.map.operator.measure
    monkeypatch.setattr(tracker.map.operator, "measure", noted)
    global_bundle(tracker, ends=True)
    assert all(matched)


class UnsteadyFlow(BentFlow):
    """Matches that err alike for a while, as if the lens bent one way, and then the other."""

    def _match(self, source, target) -> FlowMatch:
        found = super()._match(source, target)
        sizes = torch.tensor(ERRORS) * (1 if min([*source, *target]) < COUNT // 2 else -1)
        off = torch.einsum("k,k...->...", sizes, lens_shapes(CAMERA, found.pixels))
        return FlowMatch(found.pixels + off, found.weight)


ERRORS = 0.0, 0.02, -0.03, 0.0, 0.0


@pytest.mark.parametrize("agree", [True, False])
def test_a_given_lens_is_changed_only_where_halves_of_the_video_agree(monkeypatch, agree):
    """However sure all matches together are."""
    T = forward(count=COUNT)
    flow = BentFlow(T, ERRORS[1:3]) if agree else UnsteadyFlow(T, (0.0, 0.0))
    tracker = walked_tracker(CAMERA, flow, image_of)
    ids = list(range(COUNT))
    tracker.map.graph.measure([(a, a + 1) for a in ids[:-1]], packed=True)
    matches = KeyframeMatches(tracker, ids[1:], ids)
    matches.adjust()
    monkeypatch.setattr(lens_correction, "EVIDENCE", 0.0)
    assert bool(lens_correction.correct_lens(matches)) is agree


def test_while_tracking_goes_on_the_focal_length_stays(monkeypatch):
    monkeypatch.setattr(lens_correction, "FOCAL_EVIDENCE", 1.0)
    monkeypatch.setattr(lens_correction, "FOCAL_DOUBT", 1.0)
    tracker, _ = tracker_of(BEND, -0.05)
    global_bundle(tracker)
    assert tracker.keyframes.grid.camera == CAMERA


def test_a_lens_that_is_known_is_left_alone():
    tracker, _ = tracker_of((0.0, 0.0))
    ids = list(range(COUNT))
    tracker.map.graph.measure([(a, a + 1) for a in ids[:-1]], packed=True)
    matches = KeyframeMatches(tracker, ids[1:], ids)
    matches.adjust()
    before = {e: v.position.clone() for e, v in tracker.map.graph.edges.items()}
    assert not lens_correction.correct_lens(matches)
    for pair, edge in tracker.map.graph.edges.items():
        assert torch.equal(edge.position, before[pair])
