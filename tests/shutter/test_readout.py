"""The readout found from pairs of views: of points seen row by row, and of a rendered video."""

import functools
from collections.abc import Callable

import numpy as np
import pytest

from geogs.geometry.camera import Camera
from geogs.shutter.camera import RollingCamera
from geogs.shutter.epipolar import relative_pose
from geogs.shutter.moments import Passage
from geogs.shutter.readout import (
    CLIP,
    FoundReadout,
    _Equation,
    _Pair,
    _Posed,
    _verdict,
    find_readout,
)
from geogs.shutter.turning import rotated
from geogs.types import Frame
from rolling_scenes import RATE, hand_held, rolling_image
from tracking_scenes import CAMERA

WIDE = RollingCamera(Camera(420.0, 420.0, 255.5, 191.5, 512, 384))
FOCAL = 420.0
TRUE = 0.0216
Path = Callable[[float], tuple[np.ndarray, np.ndarray]]


def shaken(seed: int) -> Path:
    """Rotation vector and position of the world in a camera that a hand shakes."""
    phases, sizes = np.random.default_rng(seed).uniform(0.5, 1, (2, 6))
    waves = 2 * np.pi * np.linspace(1.0, 2.2, 6)

    def at(time: float) -> tuple[np.ndarray, np.ndarray]:
        wave = sizes * np.sin(waves * time + 6 * phases)
        return 0.06 * wave[:3], 0.12 * wave[3:]

    return at


def steady(seed: int) -> Path:
    """One that goes by without turning, at a constant speed."""
    return lambda time: (np.zeros(3), np.array([0.4, 0.01 * seed, 0.0]) * time)


def seen(path: Path, points: np.ndarray, time: float, readout: float) -> np.ndarray:
    """Pixels of the points in the image whose middle row is seen at a time, one by one in turn."""
    times = np.full(len(points), time)
    for _ in range(5):
        turns, moves = zip(*map(path, times), strict=True)
        pixels = WIDE.pixels(rotated(points, np.array(turns)) + np.array(moves))
        times = time + readout * WIDE.line_times(pixels)
    return pixels


def passage(path: Path, points: np.ndarray, middle: float, readout: float, rng) -> Passage:
    times = np.arange(-2, 3) / RATE
    pixels = [seen(path, points, middle + t, readout) for t in times]
    pixels = [p + rng.normal(0, 0.05, p.shape) for p in pixels]
    rays = [WIDE.rays(p) for p in pixels]
    lines = np.array([WIDE.line_times(p) for p in pixels])
    return Passage(np.array([r[:, :2] / r[:, 2:] for r in rays]), lines, times)


@functools.cache
def pairs(readout: float, motion=shaken) -> list[_Posed]:
    """A pair of each of six clips."""
    posed = []
    for clip in range(6):
        rng = np.random.default_rng(clip)
        points = rng.uniform([-2.4, -1.8, 2.5], [2.4, 1.8, 6], (60, 3))
        path = motion(clip)
        passages = [passage(path, points, t, readout, rng) for t in (0.0, 0.4)]
        pair = _Pair(clip, *passages)
        posed.append(_Posed(pair, relative_pose(*pair.at_once(0.0), 1.2 / FOCAL)))
    return posed


def test_points_seen_row_by_row_tell_the_readout():
    found = _verdict(pairs(TRUE), FOCAL)
    assert found.is_believed
    assert found.readout == found.best == pytest.approx(TRUE, rel=0.05)
    assert found.error < 0.002
    assert (found.clips, found.pairs) == (6, 6)


def test_points_seen_at_once_tell_a_global_shutter():
    found = _verdict(pairs(0.0), FOCAL)
    assert not found.is_believed
    assert found.readout == 0.0
    assert abs(found.best) < 0.001


def test_a_steady_motion_tells_nothing():
    """A camera that goes by at a constant speed shears all it sees, in all images alike."""
    found = _verdict(pairs(TRUE, steady), FOCAL)
    assert not found.is_believed
    assert found.error > 0.004


def test_few_clips_tell_nothing():
    assert _verdict(pairs(TRUE)[:2], FOCAL) == FoundReadout(clips=2, pairs=2)
    assert _verdict([], FOCAL) == FoundReadout()


def test_clips_that_disagree_are_not_believed():
    """One half has a rolling shutter, the other reads its rows the other way round."""
    both = pairs(TRUE)[:3] + pairs(-TRUE)[3:]
    found = _verdict(both, FOCAL)
    assert not found.is_believed
    assert found.error > 3 * _verdict(pairs(TRUE), FOCAL).error


def test_the_curvature_is_that_of_the_cost_whose_motion_is_free():
    """The gradient by the readout, the motion being fitted at each, by differences."""
    (posed, *_), tolerance = pairs(TRUE), 10.0
    pair, small = posed.pair, 2e-4

    def fitted(readout: float) -> _Equation:
        pose = posed.pose
        for _ in range(6):
            pose = pose.stepped(_Equation.of(pair, pose, readout, tolerance).step(0.0))
        return _Equation.of(pair, pose, readout, tolerance)

    before, here, after = (fitted(TRUE + by) for by in (-small, 0.0, small))
    slope = -(after.gradient - before.gradient) / (2 * small)
    assert here.curvature == pytest.approx(slope, rel=0.05)
    cost = [part.square / 2 for part in (before, after)]
    assert (cost[0] - cost[1]) / (2 * small) == pytest.approx(here.gradient, rel=0.05, abs=1e-6)


def test_a_video_without_texture_or_images_tells_nothing():
    assert find_readout([], RollingCamera(CAMERA)) == FoundReadout()


def clips(readout: float) -> list[list]:
    return [
        [
            Frame(k, k / RATE, rolling_image(hand_held, k / RATE, readout))
            for k in range(start, start + CLIP)
        ]
        for start in range(0, 3 * CLIP, CLIP)
    ]


@pytest.mark.system
@pytest.mark.parametrize(("readout", "least", "most"), [(0.0, 0.0, 0.0), (0.03, 0.024, 0.034)])
def test_a_rendered_video_tells_its_readout(readout, least, most):
    done = []
    found = find_readout(clips(readout), RollingCamera(CAMERA), done.append)
    assert least <= found.readout <= most
    assert done == sorted(done)
    assert done[-1] == 1.0
