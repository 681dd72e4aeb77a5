"""The readout found from pairs of views: of points seen row by row, and of a rendered video."""

import functools

import numpy as np
import pytest
import torch

from geogs.geometry.camera import Camera
from geogs.geometry.lie import so3_exp
from geogs.shutter.camera import RollingCamera
from geogs.shutter.readout import CANDIDATES, View, _curve, _minimum, _pairs, _verdict, find_readout
from geogs.shutter.turning import Turning, rotated
from rolling_scenes import hand_held, rolling_frames
from tracking_scenes import CAMERA

WIDE = RollingCamera(Camera(420.0, 420.0, 255.5, 191.5, 512, 384))
TRUE = 0.0216
NO_IMAGE = np.zeros((1, 1), np.uint8)


@functools.cache
def curves(readout: float, pairs: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Costs over the candidates of pairs of views of random points, and how the views' rates
    differ; the camera turns at known rates."""
    rng = np.random.default_rng(3)
    found, apart = [], []
    for _ in range(pairs):
        points = rng.uniform([-2.4, -1.8, 2.5], [2.4, 1.8, 6], (120, 3))
        rates = rng.normal(0, 0.5, (2, 3))
        motions = [(np.zeros(3), np.zeros(3)), (rng.normal(0, 0.05, 3), rng.normal(0, 0.2, 3))]
        pixels = []
        for (turn, move), rate in zip(motions, rates, strict=True):
            middle = points @ so3_exp(torch.tensor(turn)).numpy().T + move
            seen = WIDE.pixels(middle)
            for _ in range(4):
                times = readout * WIDE.line_times(seen)
                seen = WIDE.pixels(rotated(middle, times[:, None] * rate))
            pixels.append(seen + rng.normal(0, 0.2, seen.shape))
        views = [View(0.0, NO_IMAGE, Turning(rate), Turning(rate)) for rate in rates]
        found.append(_curve(WIDE, (views[0], views[1]), (pixels[0], pixels[1])))
        apart.append(np.linalg.norm(rates[0] - rates[1]))
    return np.array(found), np.array(apart)


def test_points_seen_row_by_row_tell_the_readout():
    found = _verdict(*curves(TRUE), WIDE.camera.fy)
    assert found.is_believed
    assert found.readout == found.best == pytest.approx(TRUE, rel=0.03)
    assert found.share > 0.9
    assert found.evidence > 5
    assert (found.pairs, found.shift > 1) == (12, True)


def test_points_seen_at_once_tell_a_global_shutter():
    found = _verdict(*curves(0.0), WIDE.camera.fy)
    assert not found.is_believed
    assert (found.readout, found.share) == (0.0, 0.0)
    assert found.best < 0.001


def test_few_pairs_or_little_turning_tell_nothing():
    costs, apart = curves(TRUE)
    assert not _verdict(costs[:11], apart[:11], WIDE.camera.fy).is_believed
    assert _verdict(costs, apart, WIDE.camera.fy).is_believed
    assert not _verdict(costs, 0.02 * apart, WIDE.camera.fy).is_believed


def test_pairs_that_disagree_tell_nothing():
    """Each pair has a minimum somewhere; the mean of all has one, too, that means nothing."""
    rng = np.random.default_rng(0)
    costs = 1 + 0.02 * rng.normal(size=(30, len(CANDIDATES)))
    assert not _verdict(costs, np.full(30, 0.5), WIDE.camera.fy).is_believed


def test_the_minimum_of_a_parabola_is_between_the_candidates():
    for true in (0.0047, 0.0201, 0.0342):
        assert _minimum((CANDIDATES - true) ** 2) == pytest.approx(true, abs=1e-6)
    assert _minimum(CANDIDATES) == 0.0


def test_rates_are_linear_in_the_readout():
    view = View(0.0, NO_IMAGE, Turning(np.full(3, 1.0)), Turning(np.full(3, 1.2), np.full(3, 2.4)))
    half = view.turning(float(CANDIDATES[-1]) / 2)
    np.testing.assert_allclose(half.rate, 1.1)
    np.testing.assert_allclose(half.acceleration, 1.2)


def test_pairs_are_of_views_across_a_gap_that_turn_apart_and_spread():
    """Ten views a second; every fifth turns by a radian per second, the others do not."""
    views = [
        View(0.1 * k, NO_IMAGE, Turning(np.array([0.0, float(k % 5 == 0), 0.0])), Turning())
        for k in range(30)
    ]
    pairs = _pairs(views, 0.5)
    assert pairs
    assert all((i % 5 == 0) != (j % 5 == 0) for i, j in pairs)
    assert all(1 <= j - i <= 6 for i, j in pairs)
    assert max(sum(k in pair for pair in pairs) for k in range(30)) <= 4
    assert _pairs(views, 1.5) == []
    assert _pairs([], 0.5) == []


def test_a_video_without_texture_or_images_tells_nothing():
    empty = find_readout([], RollingCamera(CAMERA))
    assert (empty.readout, empty.pairs) == (0.0, 0)


@pytest.mark.system
@pytest.mark.parametrize(("readout", "least", "most"), [(0.0, 0.0, 0.0), (0.03, 0.026, 0.034)])
def test_a_rendered_video_tells_its_readout(readout, least, most):
    frames = rolling_frames(hand_held, 60, readout)
    done = []
    found = find_readout(frames, RollingCamera(CAMERA), done.append)
    assert least <= found.readout <= most
    assert done == sorted(done)
    assert done[-1] == 1.0
