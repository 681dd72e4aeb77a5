"""Which frames of a video structure from motion is given."""

from collections.abc import Sequence

import cv2
import numpy as np
import pytest

from geogs.application.structure_from_motion import chosen_frames
from geogs.application.structure_from_motion.chosen_frames import (
    choose_frames,
    motion,
    sharpness,
    stretch_length,
)
from geogs.types import Frame

WIDE = cv2.GaussianBlur(
    np.random.default_rng(0).integers(0, 255, (120, 2000, 3), dtype=np.uint8), (0, 0), 1.0
)


def panned(columns: Sequence[int]) -> list[Frame]:
    """Frames of 160 x 120 pixels whose left edges are at some columns of a wide picture."""
    return [
        Frame(k, k / 30, np.ascontiguousarray(WIDE[:, c : c + 160])) for k, c in enumerate(columns)
    ]


def chosen(frames: list[Frame], fps: float = 30.0) -> list[int]:
    return [frame.index for frame in choose_frames(frames, fps, len(frames)).frames]


def test_of_each_stretch_the_sharpest_frame_is_taken():
    frames = panned([0] * 90)
    blurred = {n: cv2.GaussianBlur(frames[0].image, (0, 0), 0.5 + n % 5 / 5) for n in range(90)}
    frames = [Frame(k, k / 30, blurred[k] if k % 7 else frames[0].image) for k in range(90)]
    found = choose_frames(frames, 30.0, 90)
    assert stretch_length(30.0, 90) == 2
    assert len(found.frames) == 45
    assert set(range(0, 90, 7)) <= {frame.index for frame in found.frames}
    np.testing.assert_allclose(found.timestamps, np.arange(90) / 30)


def test_frames_that_hardly_overlap_are_all_taken():
    assert chosen(panned(range(0, 1600, 40))) == list(range(40))
    # Pictures whose motion nobody can follow, too.
    jumps = np.random.default_rng(1).permutation(40) * 46
    assert chosen(panned(jumps)) == list(range(40))


def test_a_stretch_ends_where_the_image_has_moved(monkeypatch):
    monkeypatch.setattr(chosen_frames, "MIN_FRAMES", 5)
    slow = [0] * 60
    fast = np.concatenate([slow, np.arange(60) * 8])  # a twentieth of the width each
    found = chosen(panned(fast))
    assert stretch_length(30.0, 120) == 10
    assert sum(k < 60 for k in found) == 6
    assert 18 <= sum(k >= 60 for k in found) <= 22
    assert max(np.diff(found)) < 20


def test_there_are_not_more_than_can_be_placed(monkeypatch):
    monkeypatch.setattr(chosen_frames, "MAX_MOVING_FRAMES", 30)
    found = chosen(panned(range(0, 1600, 40)))
    assert 20 <= len(found) <= 30


def test_motion_is_that_of_most_corners():
    before, right, gone = (cv2.cvtColor(f.image, cv2.COLOR_RGB2GRAY) for f in panned([0, 8, 900]))
    assert motion(before, right) == pytest.approx(8 / 160, abs=0.002)
    assert motion(before, before) == pytest.approx(0, abs=1e-4)
    assert motion(before, gone) == 1
    assert motion(np.zeros_like(before), before) == 1


def test_sharpness_falls_with_blur():
    grey = cv2.cvtColor(WIDE, cv2.COLOR_RGB2GRAY)
    assert sharpness(grey) > sharpness(cv2.GaussianBlur(grey, (0, 0), 0.7)) > 0


@pytest.mark.parametrize(
    ("fps", "length", "every"),
    [(30.0, None, 10), (30.0, 1000, 10), (30.0, 100, 2), (30.0, 10_000, 40), (5.0, 90, 1)],
)
def test_about_three_frames_a_second_but_neither_few_nor_very_many(fps, length, every):
    assert stretch_length(fps, length) == every
