"""Frames that come while a keyframe is being completed: found at once, and kept like others."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geogs.config import Config
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.tracking.tracker import Tracker, lone_tracker
from geogs.types import Frame
from geogs.world.segments import TrackState
from tracking_runs import CONFIG, metric_errors_cm
from tracking_scenes import CAMERA, ExactDepth, render, sideways

LENGTH = 11


@pytest.fixture(scope="module")
def stream() -> list[Frame]:
    frames = []
    for k, T in enumerate(sideways(LENGTH)):
        image, depth = render(T)
        frames.append(Frame(k, k / 30, image, depth=None if k else ExactDepth(depth)))
    return frames


def until_keyframe(stream: list[Frame]) -> tuple[Tracker, int]:
    """A tracker that has just made a keyframe and not completed it, and the next frame's place."""
    tracker = lone_tracker(CAMERA, Config(tracking=CONFIG), defers=True)
    for n, frame in enumerate(stream):
        tracker.track(frame)
        if tracker.is_unfinished:
            return tracker, n + 1
    raise AssertionError("no frame became a keyframe")


def centre(T_cw: torch.Tensor) -> np.ndarray:
    return se3_inverse(T_cw)[:3, 3].numpy()


def errors_cm(tracker: Tracker) -> np.ndarray:
    """Errors of all frames, which have to be tracked, in centimetres."""
    found = tracker.trajectory()
    assert found.tracked.all()
    return metric_errors_cm(found.T_wc, np.stack(sideways(LENGTH)))


def run(stream: list[Frame], beside: int) -> tuple[Tracker, list[np.ndarray]]:
    """The whole stream, ``beside`` frames while each keyframe is completed; places at once."""
    tracker = lone_tracker(CAMERA, Config(tracking=CONFIG), defers=True)
    follower, places = None, []
    for frame in stream:
        if follower is not None and len(follower.frames) < beside and follower.follow(frame):
            places.append(centre(follower.T_cw))
            continue
        if follower is not None:
            tracker.complete()
            tracker.take_over(follower)
            follower = None
        result = tracker.track(frame)
        assert result.state is TrackState.TRACKING
        places.append(centre(tracker.T_cw))
        follower = tracker.follower() if tracker.is_unfinished else None
    if follower is not None:
        tracker.complete()
        tracker.take_over(follower)
    tracker.finish()
    return tracker, places


@pytest.fixture(scope="module")
def completed(stream) -> Tracker:
    """Nobody came meanwhile."""
    return run(stream, beside=0)[0]


def test_nothing_changes_where_nobody_comes_meanwhile(stream, completed):
    tracker = lone_tracker(CAMERA, Config(tracking=CONFIG))
    for frame in stream:
        tracker.track(frame)
    tracker.finish()
    assert len(tracker.segment.ids) > 2
    assert np.array_equal(tracker.trajectory().T_wc, completed.trajectory().T_wc)


def test_followed_frames_are_as_right_as_others(stream, completed):
    followed, places = run(stream, beside=2)
    usual = errors_cm(completed).max()
    assert errors_cm(followed).max() < max(1.5 * usual, 0.3)
    assert len(followed.map.recorder.log.records) == LENGTH
    truth = np.stack(sideways(LENGTH))
    from_first = (np.linalg.inv(truth[0]) @ truth)[:, :3, 3]  # the map is in its frame
    assert 100 * np.linalg.norm(np.stack(places) - from_first, axis=1).max() < 1.0


def test_frames_move_with_their_keyframe_when_a_correction_came_meanwhile(stream):
    tracker, n = until_keyframe(stream)
    follower = tracker.follower()
    assert follower.follow(stream[n]) is not None
    assert follower.follow(stream[n + 1]) is not None
    T_rel = follower.frames[-1].T_rel
    tracker.complete()
    S = 2 * se3_exp(torch.tensor([0.3, -0.2, 0.1, 0.2, 0.1, -0.3], dtype=torch.float64))
    S[3, 3] = 1.0
    tracker.keyframes.correct(tracker.keyframes.moved(S))
    tracker.take_over(follower)
    keyframe = tracker.keyframes[follower.last.keyframe]
    assert keyframe.scale == pytest.approx(0.5)
    half = T_rel.clone()
    half[:3, 3] /= 2
    torch.testing.assert_close(tracker.T_cw, half @ keyframe.T_cw, rtol=0, atol=1e-12)
    record = tracker.map.recorder.log.records[-1]
    assert record.anchor == keyframe.id
    torch.testing.assert_close(record.T_rel, half, rtol=0, atol=1e-12)


def test_a_follower_knows_what_it_cannot_do(stream):
    tracker, n = until_keyframe(stream)
    follower = tracker.follower()
    assert follower.deviation()().position < 0.1
    black = np.zeros_like(stream[n].image)
    assert follower.follow(replace(stream[n], image=black)) is None
    assert follower.follow(replace(stream[n], image=black[:-8])) is None
    assert follower.follow(replace(stream[n], follows_cut=True)) is None
    far, _ = render(sideways(LENGTH + 5)[-1])
    assert follower.follow(replace(stream[-1], image=far)) is None  # too far from the keyframe
    assert follower.frames == []
    assert follower.last.keyframe == tracker.keyframes.ids[-1]


def test_what_it_locates_at_stays_as_it_was(stream):
    tracker, n = until_keyframe(stream)
    follower, keyframe = tracker.follower(), tracker.keyframes[tracker.keyframes.ids[-1]]
    before, depth = keyframe.T_cw.clone(), keyframe.inverse_depth.clone()
    tracker.complete()
    assert not torch.equal(keyframe.inverse_depth, depth)
    assert torch.equal(follower._keyframe.inverse_depth, depth)
    assert torch.equal(follower._keyframe.T_cw, before)
    assert follower.follow(stream[n]) is not None
