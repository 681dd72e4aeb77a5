"""A tracker that goes on in the world of a saved map."""

import numpy as np
import pytest
import torch

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.tracking.keyframe_uncertainty import keyframe_uncertainty
from geogs.tracking.keyframes.segment_map import add_saved_keyframes, depth_on_grid
from geogs.tracking.tracker import Tracker, lone_tracker
from geogs.types import Frame, RenderedKeyframe
from geogs.world.grid import SampleGrid
from geogs.world.segments import TrackState
from tracking_scenes import CAMERA, frames, render, sideways

PATH = sideways(30)
SMALL = CAMERA.with_long_edge(96)


def place(T_wc: np.ndarray, camera: Camera = SMALL) -> RenderedKeyframe:
    """A keyframe of a saved map that shows exactly what there is."""
    _, depth = render(T_wc, camera)
    depth = torch.from_numpy(depth).float()
    return RenderedKeyframe(
        0, camera, torch.from_numpy(np.linalg.inv(T_wc)), depth, torch.zeros(*depth.shape, 3),
        torch.ones_like(depth), render(T_wc)[0], 0.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    tracker = lone_tracker(CAMERA)
    add_saved_keyframes(tracker.segment, [place(PATH[n]) for n in (0, 5, 10)])
    for frame in frames(PATH[2:18]):
        tracker.track(frame)
    return tracker


def test_a_camera_is_found_in_the_map_and_followed_out_of_it(tracker):
    trajectory = tracker.trajectory()
    assert trajectory.tracked.all()
    error = np.linalg.norm(trajectory.T_wc[:, :3, 3] - np.array(PATH[2:18])[:, :3, 3], axis=1)
    assert error.max() < 0.01  # metres: the map's own unit, without any alignment
    assert error[:9].max() < 0.004


def test_what_is_held_stays(tracker):
    ids = sorted(tracker.segment.fixed)
    for id, n in zip(ids, (0, 5, 10), strict=True):
        assert np.array_equal(tracker.keyframes[id].T_cw, np.linalg.inv(PATH[n]))
    assert len(tracker.segment.free) >= 2
    segment, local = tracker.segment, tracker.local
    assert set(segment.fixed).isdisjoint([*segment.free, *local.active, *local.deep])


def test_new_keyframes_are_known_relative_to_the_map(tracker):
    found = keyframe_uncertainty(tracker)
    times = [tracker.keyframes[k].timestamp for k in tracker.segment.free]
    assert found.timestamps == pytest.approx(times)
    assert 0 < found.position[0] < 0.02


def test_depth_between_pixels_is_that_of_the_plane_and_unknown_across_an_edge():
    grid = SampleGrid(CAMERA)
    inverse, sure = depth_on_grid(grid, place(PATH[3]))
    _, truth = render(PATH[3])
    x, y = grid.pixels.long().unbind(-1)
    truth = torch.from_numpy(truth)[y, x].float()
    assert 0.85 < float((sure > 0).float().mean()) < 1.0
    error = (1 / inverse - truth).abs() / truth
    assert float(error[sure > 0].quantile(0.98)) < 2e-3


def test_images_of_another_camera_are_refused():
    tracker = lone_tracker(CAMERA.with_long_edge(96))
    with pytest.raises(InputError, match="192 x 144 pixels, those of the video 96 x 72"):
        add_saved_keyframes(tracker.segment, [place(PATH[0])])


def test_a_map_that_shows_another_place_is_not_believed():
    tracker = lone_tracker(CAMERA)
    add_saved_keyframes(tracker.segment, [place(PATH[0])])
    noise = np.random.default_rng(0).integers(0, 255, (144, 192, 3), np.uint8)
    assert tracker.track(Frame(0, 0.0, noise)).state is TrackState.LOST
    assert tracker.deviation() is None
