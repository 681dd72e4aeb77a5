"""A lens that is focused anew and moved: what is drawn through it, and in which bounds."""

import numpy as np
import pytest

from geogs.geometry.camera import Camera
from geogs_synth.camera.flaws import Flaws
from geogs_synth.camera.radial_camera import MovingLens, RadialCamera

LENS = RadialCamera(Camera(fx=100.0, fy=110.0, cx=39.5, cy=29.5, width=80, height=60), 0.05, -0.02)


def test_a_lens_without_these_flaws_is_the_same():
    moving = MovingLens(LENS, Flaws(noise=3.0), seed=1)
    assert moving.at(0.3) is LENS
    assert moving.in_rows(np.array([0.3, 0.4])) is LENS


@pytest.mark.parametrize("k1", [0.0, 0.05])
def test_each_row_is_seen_by_the_lens_as_it_is_at_its_time(k1):
    lens = RadialCamera(LENS.camera, k1)
    moving = MovingLens(lens, Flaws(focusing=0.02, stabilisation=0.015), 1)
    times = 0.4 + 0.03 * np.arange(60) / 59
    x, y = moving.in_rows(times).rays
    for row in (0, 20, 59):
        own = moving.at(times[row]).rays
        np.testing.assert_allclose((x[row], y[row]), (own[0][row], own[1][row]), atol=1e-9)
    assert np.abs(x - moving.at(times[30]).rays[0]).max() > 0.001
    left, top, right, bottom = moving.in_rows(times).view
    assert left < x.min()
    assert right > x.max()
    assert top < y.min()
    assert bottom > y.max()


def test_focusing_changes_the_focal_length_alone_and_stabilisation_the_centre():
    times = np.arange(300) / 30
    focused = [MovingLens(LENS, Flaws(focusing=0.02), 1).at(t).camera for t in times]
    factor = np.array([c.fx for c in focused]) / 100
    assert np.abs(factor - 1).max() == pytest.approx(0.02, rel=0.35)
    assert np.abs(np.diff(factor)).max() < 0.003  # from one image to the next
    assert all(c.fy == pytest.approx(1.1 * c.fx) for c in focused)
    assert {(c.cx, c.cy) for c in focused} == {(39.5, 29.5)}
    moved = [MovingLens(LENS, Flaws(stabilisation=0.015), 1).at(t).camera for t in times]
    off = np.array([[(c.cx - 39.5) / c.fx, (c.cy - 29.5) / c.fy] for c in moved])
    assert np.abs(off).max() == pytest.approx(0.015, rel=0.35)
    assert {(c.fx, c.fy) for c in moved} == {(100.0, 110.0)}


def test_what_it_bends_stays_and_seeds_tell_lenses_apart():
    one, other = (MovingLens(LENS, Flaws(focusing=0.02), seed).at(0.2) for seed in (1, 2))
    assert (one.k1, one.k2) == (LENS.k1, LENS.k2)
    assert one.camera.fx != other.camera.fx
    assert MovingLens(LENS, Flaws(focusing=0.02), 1).at(0.2) == one
