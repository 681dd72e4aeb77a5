"""A clip's equation for the readout, against least squares over all unknowns at once."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from geogs.camera.shutter import row_adjustment
from geogs.camera.shutter.clip_reconstruction import ClipReconstruction
from geogs.camera.shutter.first_reconstruction import first_reconstruction
from geogs.camera.shutter.row_adjustment import (
    NODES,
    interpolation,
    interpolation_slope,
    readout_equation,
)
from row_by_row import FOCAL, clip_of, scattered, shaken

READOUT, TOLERANCE = 0.02, 0.5 / FOCAL


@pytest.fixture(scope="module")
def tracks():
    return clip_of(shaken(1), scattered(1, 35), READOUT, images=11)


@pytest.fixture(scope="module")
def start(tracks) -> ClipReconstruction:
    found = first_reconstruction(tracks, 1.2 / FOCAL)
    assert found is not None
    return found


@pytest.mark.parametrize("around", [NODES, 3])
def test_interpolation_is_exact_for_polynomials(tracks, around):
    def path(t):
        return 0.3 - t + 4 * t**2 + (20 * t**3 - 70 * t**4 if around == NODES else 0)

    share, count = interpolation(tracks, READOUT, around), len(tracks.times)
    when = tracks.times[:, None] + READOUT * tracks.line_times
    for k in range(count):
        first = min(max(k - around // 2, 0), count - around)
        value = share[k] @ path(tracks.times[first : first + around])
        np.testing.assert_allclose(value, path(when[k]), atol=1e-12)
    small = 1e-4
    ends = [interpolation(tracks, READOUT + by, around) for by in (small, -small)]
    slope = (ends[0] - ends[1]) / (2 * small)
    found = interpolation_slope(tracks, READOUT, around)
    np.testing.assert_allclose(found, slope, rtol=1e-3, atol=0.02)


def test_of_the_velocity_of_a_wave_three_poses_miss_the_root_of_what_five_do(tracks):
    middle, interval = tracks.middle, tracks.times[1] - tracks.times[0]
    at_middle = replace(tracks, line_times=np.zeros_like(tracks.line_times))
    for angle in (0.3, 0.6):
        missing = []
        for around in (3, NODES):
            # What a point moves as the readout grows is its velocity times the time of its row.
            slope = interpolation_slope(tracks, 0.0, around) - interpolation_slope(
                at_middle, 0.0, around
            )
            nodes = np.sin(angle * (np.arange(around) - around // 2))
            late = np.argmax(np.abs(tracks.line_times[middle]))
            moved = slope[middle, late] @ nodes / tracks.line_times[middle, late]
            missing.append(1 - moved / (angle / interval))
        assert missing[0] == pytest.approx(angle**2 / 6, rel=0.1)
        assert missing[1] == pytest.approx(angle**4 / 30, rel=0.1)


def errors(tracks, at: ClipReconstruction, readout: float, around: int = NODES) -> np.ndarray:
    """One by one, 0 where nothing is seen."""
    share, count = interpolation(tracks, readout, around), len(tracks.times)
    projected, left = at.projected(), np.zeros_like(tracks.plane)
    for k, n in np.argwhere(tracks.seen):
        first = min(max(k - around // 2, 0), count - around)
        left[k, n] = tracks.plane[k, n] - share[k, n] @ projected[first : first + around, n]
    return left


@pytest.mark.parametrize("around", [NODES, 3])
def test_the_equation_is_that_of_least_squares_over_everything(tracks, start, monkeypatch, around):
    monkeypatch.setattr(row_adjustment, "DAMPING", 1e-12)
    left = partial(errors, tracks, around=around)
    here = left(start, READOUT)
    square = (here**2).sum(axis=-1, keepdims=True)
    root = np.sqrt(tracks.seen[..., None] / (1 + square / TOLERANCE**2) ** 2) / TOLERANCE
    (count, n), small = tracks.seen.shape, 1e-6
    columns = []
    # Scale is fixed by one coordinate of one pose, as the slight damping leaves it open.
    poses = [(k, c) for k in range(count) if k != tracks.middle for c in range(6)]
    for k, c in poses:
        by = np.zeros((count, 6))
        by[k, c] = small
        ends = [left(start.stepped(s * by, np.zeros((n, 3))), READOUT) for s in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * small))
    for p in range(n):
        for c in range(3):
            by = np.zeros((n, 3))
            by[p, c] = small
            ends = [left(start.stepped(np.zeros((count, 6)), s * by), READOUT) for s in (1, -1)]
            columns.append((ends[0] - ends[1]) / (2 * small))
    slope = [left(start, READOUT + by) for by in (1e-4, -1e-4)]
    of_readout = (root * (slope[0] - slope[1]) / 2e-4).ravel()
    J = np.stack([(root * c).ravel() for c in columns], axis=1)
    right = (root * here).ravel()
    free_slope = of_readout - J @ np.linalg.lstsq(J, of_readout, rcond=1e-9)[0]
    found = readout_equation(tracks, start, np.array([READOUT]), TOLERANCE, around)
    assert found.curvature[0, 0] == pytest.approx(free_slope @ free_slope, rel=0.01)
    free_right = right - J @ np.linalg.lstsq(J, right, rcond=1e-9)[0]
    assert found.gradient[0] == pytest.approx(-free_slope @ free_right, rel=0.02)
    assert found.square == pytest.approx((right**2).sum())


def test_steps_lower_the_cost_and_end_where_the_readout_is_right(tracks, start):
    here, readout, costs = start, np.zeros(1), []
    for _ in range(12):
        part = readout_equation(tracks, here, readout, 3 * TOLERANCE)
        step = np.clip(part.gradient / part.curvature[0], -0.01, 0.01)
        here, readout = part.stepped(here, step), readout + step
        costs.append(part.square)
    assert readout[0] == pytest.approx(READOUT, abs=0.004)
    assert costs[-1] < 0.5 * costs[0]


def test_a_point_that_seems_to_be_next_to_the_camera_does_not_outweigh_the_others(tracks, start):
    plain = readout_equation(tracks, start, np.zeros(1), TOLERANCE)
    k = tracks.middle + 3
    beside = start.points.copy()
    # So near that it is a thousandth of its depth before the camera there.
    x, y, _ = beside[0]
    beside[0, 2] = (1e-3 - start.R[k, 2] @ [x, y, 1]) / start.t[k, 2]
    found = readout_equation(tracks, replace(start, points=beside), np.zeros(1), 50 * TOLERANCE)
    wide = readout_equation(tracks, start, np.zeros(1), 50 * TOLERANCE)
    assert plain.cost < 1
    assert found.curvature[0, 0] < 1.2 * wide.curvature[0, 0]
