"""Motion, overlap and sharpness decide which frames become keyframes."""

import cv2
import numpy as np
import pytest

from geogs.config import TrackingConfig
from geogs.tracking.keyframes.keyframe_choice import KeyframeChoice, is_near_end, sharpness

CONFIG = TrackingConfig(keyframe_parallax=0.025, keyframe_overlap=0.7)


def texture(seed: int = 0) -> np.ndarray:
    """Large surfaces with a grain, as in pictures."""
    random = np.random.default_rng(seed)
    surfaces = np.kron(random.integers(40, 200, (6, 8, 3)), np.ones((20, 20, 1)))
    grain = cv2.GaussianBlur(random.normal(0, 40, (120, 160, 3)), (0, 0), 1.0)
    return np.clip(surfaces + grain, 0, 255).astype(np.uint8)


def is_chosen(flow: float, overlap: float) -> bool:
    return KeyframeChoice(CONFIG, 512).calls_for(flow, overlap, flow)


def test_motion_makes_a_keyframe_whatever_overlaps() -> None:
    assert is_chosen(12.9, 1.0)
    assert not is_chosen(12.7, 1.0)


def test_before_depths_are_known_the_rotation_counts_and_more_is_asked_for() -> None:
    choice = KeyframeChoice(CONFIG, 512)
    assert not choice.calls_for(17.9, 1.0)
    assert choice.calls_for(18.0, 1.0)


def test_near_the_end_a_third_of_the_parallax_is_enough() -> None:
    choice = KeyframeChoice(CONFIG, 512)
    assert not choice.calls_for(4.2, 1.0, 4.2, near=True)
    assert choice.calls_for(4.3, 1.0, 4.3, near=True)
    assert choice.calls_for(6.0, 1.0, near=True)
    assert not choice.calls_for(5.9, 1.0, near=True)


def test_the_end_is_near_where_no_usual_keyframe_comes_any_more() -> None:
    assert is_near_end(8, [10, 15, 24])
    assert not is_near_end(9, [10, 15, 24])
    assert is_near_end(8, [15, 24, 27, 30])  # the latest are closer because it is
    assert not is_near_end(0, [10])
    assert not is_near_end(None, [10, 15, 24])


def test_lost_overlap_makes_a_keyframe_before_the_median_motion_does() -> None:
    assert is_chosen(6.0, 0.65)
    assert not is_chosen(6.0, 0.75)


def test_a_poor_image_of_a_resting_camera_is_no_keyframe() -> None:
    assert not is_chosen(2.0, 0.3)


def test_blur_takes_sharpness_and_light_does_not() -> None:
    sharp = texture()
    blurred = cv2.blur(sharp, (7, 1))
    assert sharpness(blurred) < 0.6 * sharpness(sharp)
    darker = (0.7 * sharp.astype(np.float32) + 10).astype(np.uint8)
    assert sharpness(darker) == pytest.approx(sharpness(sharp), rel=0.05)


def test_a_blurred_frame_waits_for_a_sharper_one_but_not_for_long() -> None:
    choice = KeyframeChoice(CONFIG, 512)
    for seed in range(5):
        choice.see(texture(seed))
    assert choice.calls_for(12.9, 1.0, 12.9)
    choice.see(cv2.blur(texture(5), (9, 1)))
    assert not choice.calls_for(17.8, 1.0, 17.8)
    assert choice.calls_for(18.0, 1.0, 18.0)
    assert not choice.calls_for(9.0, 0.6, 9.0)
    assert choice.calls_for(9.0, 0.45, 9.0)


def test_where_all_are_blurred_none_waits() -> None:
    choice = KeyframeChoice(CONFIG, 512)
    for seed in range(12):
        choice.see(cv2.blur(texture(seed), (9, 1)))
    assert choice.calls_for(12.9, 1.0, 12.9)


def test_a_choice_goes_on_where_another_was() -> None:
    recent: list[float] = []
    choice = KeyframeChoice(CONFIG, 512, recent)
    for seed in range(5):
        choice.see(texture(seed))
    choice.settle()
    other = KeyframeChoice(CONFIG, 512, recent)
    other.see(cv2.blur(texture(5), (9, 1)))
    assert not other.calls_for(13.0, 1.0, 13.0)


def test_a_camera_that_turns_makes_keyframes_by_what_goes_out_of_sight() -> None:
    choice = KeyframeChoice(CONFIG, 512)
    turned = 60.0
    assert not choice.calls_for(turned, 0.85, parallax=5.0)
    assert choice.calls_for(turned, 0.85, parallax=12.9)
    assert choice.calls_for(turned, 0.65, parallax=0.5)
    assert choice.calls_for(77.0, 0.85, parallax=0.5)  # farther than flow should be measured over
