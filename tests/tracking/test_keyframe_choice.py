from geogs.config import TrackingConfig
from geogs.tracking.keyframe_choice import calls_for_keyframe

CONFIG = TrackingConfig(keyframe_flow=0.025, keyframe_overlap=0.7)


def is_chosen(flow: float, overlap: float) -> bool:
    return calls_for_keyframe(CONFIG, 512, flow, overlap)


def test_motion_makes_a_keyframe_whatever_overlaps() -> None:
    assert is_chosen(12.9, 1.0)
    assert not is_chosen(12.7, 1.0)


def test_lost_overlap_makes_a_keyframe_before_the_median_motion_does() -> None:
    assert is_chosen(6.0, 0.65)
    assert not is_chosen(6.0, 0.75)


def test_a_poor_image_of_a_resting_camera_is_no_keyframe() -> None:
    assert not is_chosen(2.0, 0.3)
