"""What a run says of itself in one line."""

from dataclasses import replace

import numpy as np
import pytest

from geogs.application.results.verdict import verdict
from geogs.types import Trajectory, Uncertainty


def walk(count: int, tracked: int) -> Trajectory:
    """A straight walk of one unit, of which the first frames are tracked."""
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 3] = np.linspace(0, 1, count)
    return Trajectory(np.arange(count) / 30, T, np.arange(count) < tracked)


def known(position: float, depth: float, focal: float = 0.01) -> Uncertainty:
    n = 5
    return Uncertainty(
        np.arange(n) / 5, np.full(n, position), np.full(n, 0.01), np.full(n, depth), focal
    )  # fmt: skip


def test_a_good_run_says_how_good():
    found = verdict(walk(30, 30), walk(5, 5), known(0.0035, 0.02))
    assert found.is_reliable
    assert found.position == pytest.approx(0.0035 / np.std(np.linspace(0, 1, 5)))
    assert found.sentence == (
        "Trajectory and shape are reliable. Expected position error: 1.0% of the path's size. "
        "Expected depth error: 2.0%."
    )
    best = verdict(walk(30, 30), walk(5, 5), known(0.00012, 0.02))
    assert "position error: 0.03% of the path" in best.sentence


@pytest.mark.parametrize(
    ("tracked", "position", "depth", "reason"),
    [
        (20, 0.001, 0.01, "33% of the frames are lost"),
        (30, 0.1, 0.01, "the expected position error is 28% of the path's size"),
        (30, 0.001, 0.4, "the expected error of the best depths is 40%"),
        (30, 0.001, np.inf, "depths could not be determined"),
        (30, np.inf, 0.01, "Not reliable: positions could not be determined."),
    ],
)
def test_a_bad_run_says_why(tracked, position, depth, reason):
    found = verdict(walk(30, tracked), walk(5, 5), known(position, depth))
    assert not found.is_reliable
    assert found.sentence.startswith("Not reliable: ")
    assert reason in found.sentence


def test_a_focal_length_that_nobody_knows_is_no_shape_to_rely_on():
    found = verdict(walk(30, 30), walk(5, 5), known(0.001, 0.01, 0.3))
    assert not found.is_reliable
    assert found.focal == 0.3
    assert "focal length is uncertain by 30%: give --intrinsics" in found.sentence


def test_what_no_camera_explains_is_not_relied_on():
    found = verdict(walk(30, 30), walk(5, 5), known(0.001, 0.01, 0.05), is_explained=False)
    assert not found.is_reliable
    assert "no camera explains the motion at the start" in found.sentence


@pytest.mark.parametrize(
    ("fine", "wrong", "reason"),
    [
        (
            {"misfit": 1.25},
            {"misfit": 1.75},
            "a tenth of the keyframes fit their matches 1.8 times worse",
        ),
        (
            {"focal_change": 0.04},
            {"focal_change": 0.14},
            "by 14% between parts of the video, as with a zoom",
        ),
        ({"joined": 0.97}, {"joined": 0.6}, "only 60% of the keyframes form one rigid structure"),
        ({"lens_change": 0.06}, {"lens_change": 0.3}, "the lens changes from image to image"),
        (
            {"lens_change": 0.02, "lens_varies": True},
            {"lens_change": 0.045, "lens_varies": True},
            "the lens changes from image to image",
        ),
    ],
)
def test_where_tracking_fails_or_somebody_zooms_nothing_is_relied_on(fine, wrong, reason):
    good = known(0.001, 0.01)
    assert verdict(walk(30, 30), walk(5, 5), replace(good, **fine)).is_reliable
    found = verdict(walk(30, 30), walk(5, 5), replace(good, **wrong))
    assert not found.is_reliable
    assert reason in found.sentence


def test_a_run_without_motion_is_not_reliable():
    still = Trajectory(np.arange(5.0), np.tile(np.eye(4), (5, 1, 1)), np.ones(5, bool))
    assert not verdict(still, still, known(0.001, 0.01)).is_reliable


def test_a_run_without_a_map_says_why():
    turned = Trajectory(np.arange(4.0), walk(4, 4).T_wc, np.zeros(4, bool), np.ones(4, bool))
    none = np.zeros(0)
    nothing = Uncertainty(none, none, none, none)
    found = verdict(turned, walk(0, 0), nothing, "The camera only turns.")
    assert not found.is_reliable
    assert found.sentence == "Rotation only: no shape. The camera only turns."
    assert (found.lost, found.orientation_only) == (0, 1)


def test_much_turning_is_told():
    states = np.arange(30) < 10
    turned = Trajectory(np.arange(30.0), walk(30, 30).T_wc, states, ~states)
    found = verdict(turned, walk(5, 5), known(0.001, 0.01))
    assert not found.is_reliable
    assert "67% of the frames have an orientation but no position" in found.sentence


def test_depths_that_nobody_knows_are_no_shape():
    moving = walk(20, 20)
    assert verdict(moving, moving, known(0.001, 0.1)).has_shape
    assert not verdict(moving, moving, known(0.001, 0.6)).has_shape
    assert not verdict(moving, moving, known(0.001, np.inf)).has_shape
