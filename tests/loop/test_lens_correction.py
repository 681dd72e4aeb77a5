"""A lens in the adjustment of all keyframes: a walk past a wall, with exact matches of a lens."""

import numpy as np
import pytest
import torch
from torch import Tensor

from geogs.bundle.projection import project
from geogs.bundle.uncertainty.lens_error import lens_shapes
from geogs.camera.straight_view import FrameViews, StraightView
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.loop.camera import lens as lens_correction
from geogs.loop.camera.straightening import BentImages
from geogs.loop.global_bundle import global_bundle
from geogs.loop.keyframe_matches import KeyframeMatches
from geogs.tracking.tracker import Tracker
from geogs.types import FlowMatch
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
        super().__init__(GRID, T, torch.empty(0), 0.0)
        self.is_straight, self.left = False, (0.0, 0.0)
        """``left``: what straight images still bend."""
        self._see(torch.tensor([focal, *bend, *centre]))

    def encode(self, image: np.ndarray) -> int:
        """The number that an image stands for; from the first on that is straightened, all are."""
        if not self.is_straight and not np.array_equal(image[..., 2], NOISE):
            self.is_straight = True
            self._see(torch.tensor([0.0, *self.left]))
        return super().encode(image)

    def _see(self, bend: Tensor) -> None:
        """What the cells show, and how deep that is."""
        self.bend = bend
        centre, scale = torch.tensor([CAMERA.cx, CAMERA.cy]), torch.tensor([CAMERA.fx, CAMERA.fy])
        shown = (self._pinhole(GRID.pixels) - centre) / scale
        own = SampleGrid(CAMERA)
        self.rays = torch.cat([shown, torch.ones(GRID.size, 1)], 1)
        object.__setattr__(own, "rays", self.rays)
        self.d = true_inverse_depth(self.T, own)

    def _pinhole(self, pixels: Tensor) -> Tensor:
        shapes = lens_shapes(CAMERA, pixels)[: len(self.bend)]
        return pixels + torch.einsum("k,k...->...", self.bend, shapes)

    def _match(self, source, target) -> FlowMatch:
        i, j = list(source), list(target)
        p = project(CAMERA, self.rays, self.T[j] @ se3_inverse(self.T[i]), self.d[i])
        used = p.valid & GRID.inside(p.pixels)
        wanted = torch.where(used[..., None], p.pixels, GRID.centre)
        pixels = wanted
        for _ in range(5):
            pixels = pixels + wanted - self._pinhole(pixels)
        g = torch.Generator().manual_seed(100 * i[0] + j[0])
        pixels = pixels + 0.02 * torch.randn(pixels.shape, generator=g)
        weight = torch.where(used, 400.0, 0.0)[..., None].expand(-1, -1, 2).contiguous()
        return FlowMatch(pixels, weight)


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
    bend = lens_correction.correct_lens(matches).lens
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
        said.append(lens_correction.correct_lens(matches).lens)
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
    to_first_order = centre_error(tracker, truth)
    global_bundle(tracker, ends=True)
    lens = table.lens
    assert lens is not None
    assert (lens.k1, lens.k2) == pytest.approx(BEND, rel=0.1)
    assert 0 < lens.deviation_k1 < 0.02
    straight = tracker.keyframes[3].image
    assert np.array_equal(straight, StraightView(CAMERA, lens).image(image_of(3)))
    # Everything is of straight images now.
    assert centre_error(tracker, truth) < 0.9 * to_first_order
    wanted = tracker.map.graph.operator.d
    for keyframe in tracker.keyframes:
        known = keyframe.has_known_depth
        factor = (keyframe.inverse_depth / wanted[keyframe.id])[known]
        assert float((factor / factor.median() - 1).abs().quantile(0.9)) < 0.02
    assert not global_bundle(tracker, ends=True).after
    assert tracker.keyframes[3].image is straight


@pytest.mark.system
def test_what_straight_images_still_bend_is_part_of_the_lens(monkeypatch):
    tracker, _ = tracker_of(BEND)
    tracker.map.graph.operator.left = 0.01, -0.02
    straightened, straighten = [], BentImages.straighten

    def noted(images: BentImages, views: FrameViews) -> None:
        straightened.append(views.view.lens)
        straighten(images, views)

    monkeypatch.setattr(BentImages, "straighten", noted)
    global_bundle(tracker, ends=True)
    first, last = straightened
    assert (last.k1 - first.k1, last.k2 - first.k2) == pytest.approx((0.01, -0.02), abs=0.006)
    assert tracker.keyframes.table.lens == last


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
    # Shown at x, the ray is at 1.05 x and what the lens adds, to first order of the matches' own.
    assert lens.focal == pytest.approx(1 / 1.05, abs=0.01)
    assert abs(lens.focal - 1 / 1.05) < 2 * lens.deviation_focal < 0.04
    assert tracker.keyframes.grid.camera == tracker.keyframes.camera == CAMERA
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
    """Off by 0.04 focal lengths, of which straight images have none left."""
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
    straight = tracker.keyframes[3].image
    assert np.array_equal(straight, StraightView(CAMERA, lens).image(image_of(3)))


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
    matched: list[tuple[bool, bool]] = []
    measure = tracker.map.operator.measure

    def noted(*pairs, fine, memory):
        matched.append((tracker.keyframes.table.lens is not None, fine))
        return measure(*pairs, fine=fine, memory=memory)

    monkeypatch.setattr(tracker.map.operator, "measure", noted)
    tracker.keyframes.table.focal_deviation = 0.01
    global_bundle(tracker, ends=True)
    assert matched[0] == (False, False)
    assert matched[-1] == (is_found, True)
    assert all(fine == is_straight for is_straight, fine in matched) is is_found
    matched.clear()
    tracker, _ = tracker_of((0.02, -0.03), -0.03)
    measure = tracker.map.operator.measure
    monkeypatch.setattr(tracker.map.operator, "measure", noted)
    global_bundle(tracker, ends=True)
    assert all(fine for _, fine in matched)


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
