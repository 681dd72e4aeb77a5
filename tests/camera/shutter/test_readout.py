"""The readout found from clips: of points seen row by row, and of a rendered video."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from geogs.camera.distortion import USUAL_BEND
from geogs.camera.shutter.clip_tracks import FollowedClips
from geogs.camera.shutter.first_reconstruction import first_reconstruction
from geogs.camera.shutter.readout import (
    CLIP,
    LONGEST,
    SHORTEST,
    FoundReadout,
    _Adjusted,
    _adjusted,
    _started,
    _verdict,
    find_readout,
)
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.types import Frame
from rolling_scenes import RATE, hand_held, rolling_frames, rolling_image
from row_by_row import FOCAL, clip_of, scattered, shaken, steady
from tracking_scenes import CAMERA

TRUE = 0.0216


@functools.cache
def clips_of_points(readout: float, motion=shaken, rate: float = RATE) -> list[_Adjusted]:
    """Four of them."""
    clips = [
        clip_of(motion(seed), scattered(seed, 35), readout, images=18, rate=rate)
        for seed in range(4)
    ]
    starts = [(clip, first_reconstruction(clip, 1.2 / FOCAL)) for clip in clips]
    return [_Adjusted(clip, start) for clip, start in starts if start is not None]


def verdict(clips: list[_Adjusted], lens: tuple[float, ...] = ()) -> FoundReadout:
    return _verdict(_adjusted(clips, FOCAL, lens), FOCAL)


def test_points_seen_row_by_row_tell_the_readout():
    found = verdict(clips_of_points(TRUE))
    assert found.is_believed
    assert found.readout == found.best == pytest.approx(TRUE, rel=0.05)
    assert found.error < 0.002
    assert found.clips == 4


def test_points_seen_at_once_tell_a_global_shutter():
    found = verdict(clips_of_points(0.0))
    assert not found.is_believed
    assert found.readout == 0.0
    assert abs(found.best) < 0.001


def slowly(seed: int):
    """Waves of half a hertz to 1.1 Hz."""
    path = shaken(seed)
    return lambda time: path(time / 2)


@pytest.mark.parametrize("readout", [0.0, TRUE])
def test_few_images_a_second_tell_it_where_the_motion_is_slow(readout):
    found = verdict(clips_of_points(readout, slowly, 5.0))
    print(found)
    assert found.is_believed == (readout > 0)
    assert found.best == pytest.approx(readout, abs=max(2 * found.error, 0.0005))
    assert found.error < 0.0015


@pytest.mark.parametrize(("rate", "least_error"), [(5.0, 0.003), (4.0, 0.006)])
def test_images_too_far_apart_for_the_motion_have_a_larger_error(rate, least_error):
    """Of waves of up to 2.2 Hz they tell another velocity, in all clips alike."""
    found = verdict(clips_of_points(TRUE, shaken, rate))
    print(found)
    assert found.error > least_error
    assert abs(found.best - TRUE) < 2 * found.error
    assert not verdict(clips_of_points(0.0, shaken, rate)).is_believed


def test_a_lens_that_nobody_told_is_not_taken_for_rows():
    def bent(clip):
        square = (clip.plane**2).sum(-1, keepdims=True)
        return replace(clip, plane=clip.plane * (1 + 0.1 * square - 0.2 * square**2))

    clips = [bent(a.tracks) for a in clips_of_points(TRUE)]
    starts = [first_reconstruction(clip, 1.2 / FOCAL) for clip in clips]
    seen = [_Adjusted(c, s) for c, s in zip(clips, starts, strict=True) if s is not None]
    found, taken = verdict(seen, (1e-4, *USUAL_BEND)), verdict(seen)
    print(found, taken)
    assert found.readout == pytest.approx(TRUE, rel=0.06)
    assert abs(found.best - TRUE) < 0.5 * abs(taken.best - TRUE)


@pytest.mark.parametrize("factor", [0.85, 1.1])
def test_a_focal_length_that_nobody_told_is_not_taken_for_rows(factor):
    """Where what it is taken to be is as much too short or too long."""
    wrong = [replace(a.tracks, plane=a.tracks.plane / factor) for a in clips_of_points(TRUE)]
    starts = [_started(clip, factor * FOCAL, 1.0) for clip in wrong]
    seen = [start for start in starts if start is not None]
    found, taken = verdict(seen, (0.35, *USUAL_BEND)), verdict(seen)
    print(found, taken)
    assert found.readout == pytest.approx(TRUE, rel=0.06)
    assert abs(found.best - TRUE) < 0.5 * abs(taken.best - TRUE)


def test_what_no_readout_explains_tells_nothing():
    rng = np.random.default_rng(0)
    shaken_up = [
        replace(
            a,
            tracks=replace(a.tracks, plane=a.tracks.plane + rng.normal(0, 5 / FOCAL, (18, 35, 2))),
        )
        for a in clips_of_points(TRUE)
    ]
    assert verdict(shaken_up) == FoundReadout()


def test_a_steady_motion_tells_nothing():
    """A camera that goes by at a constant speed shears all it sees, in all images alike."""
    found = verdict(clips_of_points(TRUE, steady))
    assert not found.is_believed
    assert found.error > 0.004


def test_few_clips_tell_nothing():
    assert verdict(clips_of_points(TRUE)[:2]) == FoundReadout(clips=2)
    assert verdict([]) == FoundReadout()


@pytest.mark.parametrize(
    ("best", "error"), [(0.0, float("inf")), (0.001, 0.002), (0.009, 0.004), (0.04, 0.006)]
)
def test_what_is_left_open_is_the_mean_square_over_shutters_that_say_the_same(best, error):
    """Against shutters drawn, half of them global, and what noisy clips say of each."""
    rng = np.random.default_rng(0)
    true = rng.uniform(SHORTEST, LONGEST, 2_000_000) * rng.integers(0, 2, 2_000_000)
    said = true + rng.normal(0, error, len(true)) if np.isfinite(error) else 0 * true
    alike = true[np.abs(said - best) < 0.0003]
    assert len(alike) > 1000
    found = FoundReadout(0.0, best, error).left_open
    assert found == pytest.approx(np.sqrt((alike**2).mean()), rel=0.05)


def test_little_is_left_open_where_it_is_found_or_seen_to_be_none():
    assert FoundReadout().left_open == pytest.approx(0.0151, abs=1e-4)
    assert FoundReadout(0.02, 0.02, 0.001).left_open == 0.001
    assert FoundReadout(0.0, -0.0005, 0.002).left_open < 0.0005
    assert FoundReadout(0.0, -0.005, 0.0001).left_open < 1e-6  # impossible, hence none


def test_clips_that_disagree_are_not_believed():
    """One half has a rolling shutter, the other reads its rows the other way round."""
    both = clips_of_points(TRUE)[:2] + clips_of_points(-TRUE)[2:]
    found = verdict(both)
    assert not found.is_believed
    assert found.error > 3 * verdict(clips_of_points(TRUE)).error


def test_a_video_without_texture_or_images_tells_nothing():
    none = FollowedClips(lambda first: (clip for clip in ()))
    assert find_readout(none, RollingCamera(CAMERA)) == FoundReadout()


def test_images_that_are_alike_to_the_bit_tell_nothing():
    seen = rolling_image(hand_held, 0.0, 0.0)
    clip = [Frame(k, k / RATE, seen) for k in range(CLIP)]
    still = FollowedClips(lambda first: (clip for _ in range(3 - first)))
    assert find_readout(still, RollingCamera(CAMERA)) == FoundReadout()


@pytest.mark.system
@pytest.mark.parametrize(
    ("readout", "least", "most"),
    [pytest.param(0.0, 0.0, 0.0, marks=pytest.mark.long), (0.03, 0.024, 0.034)],
)
def test_a_rendered_video_tells_its_readout(readout, least, most):
    done, video = [], rolling_frames(hand_held, 2 * CLIP, readout)
    clips = [video[start : start + CLIP] for start in (0, CLIP // 2, CLIP)]
    followed = FollowedClips(lambda first: (clip for clip in clips[first:]))
    found = find_readout(followed, RollingCamera(CAMERA), done.append)
    assert find_readout(followed, RollingCamera(CAMERA)) == found
    assert least <= found.readout <= most
    assert done == sorted(done)
    assert done[-1] == 1.0
