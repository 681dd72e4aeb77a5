"""A pattern that repeats, in which a wrong guess leads to the wrong one of its repetitions."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import tracking_scenes
from geogs.geometry.lie import se3_inverse
from geogs.tracking.follower import Follower
from geogs.tracking.locate.frame_locator import (
    CONFIRMED_NCC,
    DOUBTFUL_OVERLAP,
    MAX_DIFFERENCE,
    FrameMotion,
)
from geogs.tracking.locate.localiser import SegmentLocaliser
from geogs.tracking.matching.photometric_check import PhotometricCheck
from geogs.tracking.tracker import Tracker, lone_tracker
from geogs.types import FlowMatch, Frame
from geogs.world.segments import LastFrame, TrackState
from tracking_scenes import CAMERA, pose, render


def motion(
    overlap: float, matched: float, known: float = 0.5, at: float = 0.0, correlation: float = 0.9
) -> FrameMotion:
    match = FlowMatch(torch.full((1, 8, 2), at), torch.ones(1, 8, 2))
    eye, check = torch.eye(4, dtype=torch.float64), PhotometricCheck(correlation, 100)
    return FrameMotion(
        9.0,
        overlap,
        match,
        9.0,
        keyframe=0,
        T_cw=eye,
        matched=matched,
        known=known,
        residual=0.3,
        check=check,
    )


def searched(
    expected: FrameMotion | None, cold: FrameMotion | None, features: FrameMotion | None
) -> tuple[FrameMotion | None, int]:
    """What a localiser settles for, and how often it searches, given what each way finds."""
    tracker = lone_tracker(CAMERA)
    image = np.zeros((144, 192, 3), np.uint8)
    keyframe = tracker.keyframes.add(0, 0.0, image, None, torch.eye(4, dtype=torch.float64))
    tracker.segment.status.last = LastFrame.at(keyframe)
    localiser, asked = SegmentLocaliser(tracker.map), []

    def found(name, result):
        return lambda *_: (asked.append(name), result)[1]

    locator = localiser.locator
    locator.locate = lambda *_: expected
    locator.relocate = found("cold", cold)
    locator.relocate_by_features = found("features", features)
    return localiser.track(Frame(1, 1 / 30, image), None), len(asked)


def test_what_most_of_the_keyframe_agrees_with_is_believed():
    sure, doubtful = motion(DOUBTFUL_OVERLAP, 0.3), motion(DOUBTFUL_OVERLAP - 0.01, 0.3)
    better, worse = motion(0.9, 0.31), motion(0.9, 0.29)
    assert searched(sure, better, better) == (sure, 0)
    assert searched(doubtful, better, motion(0.9, 0.305)) == (better, 2)
    assert searched(doubtful, None, better) == (better, 2)
    assert searched(doubtful, worse, None) == (doubtful, 2)
    assert searched(doubtful, None, None) == (doubtful, 2)
    assert searched(doubtful, motion(0.9, 0.9, known=0.01), None) == (doubtful, 2)
    assert searched(None, better, better) == (None, 0)  # others look for a camera that is lost


def test_features_are_not_asked_where_flow_leads_there_again_and_images_bear_it_out():
    doubtful, features = motion(DOUBTFUL_OVERLAP - 0.01, 0.3), motion(0.9, 0.5)
    near, far = MAX_DIFFERENCE / 2, 2 * MAX_DIFFERENCE
    for at, correlation, asked in (
        (near, CONFIRMED_NCC, 1),
        (near, 0.9, 2),
        (far, CONFIRMED_NCC, 2),
    ):
        cold = motion(0.8, 0.4, at=at, correlation=correlation)
        assert searched(doubtful, cold, features) == (cold if asked == 1 else features, asked)
    blank = replace(doubtful.match, weight=torch.zeros(1, 8, 2))
    assert not replace(doubtful, match=blank).is_where(doubtful)


def on_the_move(guess: np.ndarray) -> Tracker:
    """A tracker with one keyframe of known depth, at the middle, that expects the camera at a
    guess."""
    tracker, start = lone_tracker(CAMERA), pose(0.0)
    image, depth = render(start)
    encoded = tracker.map.operator.encode(image)
    keyframe = tracker.keyframes.add(0, 0.0, image, encoded, se3_inverse(torch.from_numpy(start)))
    keyframe.inverse_depth = torch.from_numpy(1 / depth[4:-3:8, 4:-3:8]).float().reshape(-1)
    keyframe.information = torch.full_like(keyframe.inverse_depth, 1e6)
    velocity = se3_inverse(torch.from_numpy(guess))
    status = tracker.segment.status
    status.state = TrackState.TRACKING
    eye = torch.eye(4, dtype=torch.float64)
    status.last = LastFrame(keyframe.id, eye, velocity, 1.0, 0.0, 1 / 30)
    return tracker


def error_cm(true: np.ndarray, guess: np.ndarray) -> float:
    tracker = on_the_move(guess)
    tracker.track(Frame(1, 1 / 30, render(true)[0]))
    assert tracker.T_cw is not None
    found = se3_inverse(tracker.T_cw)[:3, 3].numpy()
    return 100 * float(np.linalg.norm(found - true[:3, 3]))


@pytest.fixture
def chessboards(monkeypatch):
    """Squares of 14 cm on what the camera faces."""
    rows = np.arange(512) // 16
    board = np.where((rows[:, None] + rows) % 2, 225, 30).astype(np.float32)
    textures = [board, *tracking_scenes.TEXTURES[1:-1], board]
    monkeypatch.setattr(tracking_scenes, "TEXTURES", textures)


@pytest.mark.usefixtures("chessboards")
def test_what_comes_while_a_keyframe_is_completed_is_searched_for_a_second_time_too():
    true = pose(0.075, -0.047, yaw=0.02)
    tracker = on_the_move(pose(-0.075, 0.047, yaw=-0.02))
    last = tracker.segment.status.last
    keyframe = tracker.keyframes[last.keyframe]
    locator = SegmentLocaliser(tracker.map).locator
    follower = Follower(locator, tracker.config, last, keyframe, keyframe, motion(0.9, 0.5))
    assert follower.follow(Frame(1, 1 / 30, render(true)[0])) is not None
    found = se3_inverse(follower.T_cw)[:3, 3].numpy()
    assert 100 * float(np.linalg.norm(found - true[:3, 3])) < 0.5


@pytest.mark.system
@pytest.mark.usefixtures("chessboards")
@pytest.mark.parametrize("angle", [0.3, 1.35, 2.4, 5.55])
def test_a_camera_that_turns_back_before_a_chessboard_does_not_slip(angle):
    true = pose(0.25 * np.cos(angle), 0.18 * np.sin(angle), yaw=0.03)
    guess = pose(-0.15 * np.cos(angle), -0.11 * np.sin(angle), yaw=-0.03)
    assert error_cm(true, guess) < 1.0
