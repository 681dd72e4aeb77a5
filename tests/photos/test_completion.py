"""Frames without a place are found about those that have one; what contradicts them is not."""

import numpy as np
import pytest

from geogs.application.structure_from_motion import completion
from geogs.application.structure_from_motion.completion import LostFrames, about, as_seen
from geogs.camera.straight_view import FrameViews, StraightView
from geogs.config import InputConfig
from geogs.io.sources.sniff import open_source
from geogs.types import FoundFrames, FoundLens, Frame, FrameLens, Trajectory, Uncertainty
from geogs_photos.completion import place_lost
from handheld_walk import handheld_trajectory
from io_samples import write_image
from lit_rooms import lit_room
from posed_layouts import render_room


def test_the_nearest_known_frames_on_both_sides():
    known = [*range(0, 60, 2), 90]
    assert about([31], known) == {*range(12, 52, 2)}
    assert about([100], known) == {*range(42, 60, 2), 90}
    assert about([3], []) == set()


def test_a_lens_that_was_found_since_is_in_the_calibration():
    camera = render_room(1, 1, 32, 24).camera
    bent = as_seen(StraightView(camera, camera, FoundLens(0.1, -0.2, 0.01, 0.01, 1.02)))
    assert bent.fx == pytest.approx(1.02 * camera.fx)
    assert bent.distortion == (0.1, -0.2, 0.0, 0.0)
    assert as_seen(StraightView(camera, camera)).distortion == ()


def test_what_is_found_is_as_unsure_as_what_is_around_and_by_itself():
    known = Uncertainty(np.array([0.0, 2.0]), *(np.array([3.0, 3.0]) for _ in range(3)))
    found = FoundFrames((1,), np.array([1.0]), np.eye(4)[None], np.array([4.0]), np.array([4.0]))
    both = known.with_found(found)
    np.testing.assert_allclose(both.timestamps, [0, 1, 2])
    np.testing.assert_allclose(both.position, [3, 5, 3])
    np.testing.assert_allclose(both.rotation, [3, 5, 3])
    np.testing.assert_allclose(both.depth, 3)


@pytest.mark.parametrize(("readout", "times"), [("auto", 3), (0.0, 1), (0.02, 1)])
def test_known_frames_are_shown_as_the_lens_of_all_saw_them(monkeypatch, tmp_path, readout, times):
    """And where the axis of a lost one lay nobody knows, which turns it."""
    room = render_room(4, 1, 32, 24)
    own = FrameLens(right=0.05)
    wander = FoundLens(0.0, 0.0, 0.0, 0.0, varies_centre=0.03)
    views = FrameViews(StraightView(room.camera, room.camera, wander), {1: own, 2: own})
    for k, image in enumerate(room.images):
        write_image(tmp_path / f"{k}.png", image)
    camera = ",".join(str(getattr(room.camera, k)) for k in ("fx", "fy", "cx", "cy"))
    video = open_source((tmp_path,), InputConfig(intrinsics=camera, readout=readout))
    states = np.array([True, True, True, False])
    trajectory = Trajectory(np.arange(4) / 10, room.T_wc[:4], states)
    given = []

    def found(frames, T_cw, seen_by, seed, report) -> FoundFrames:
        given.extend(frames)
        deviation = np.array([1e-5])
        return FoundFrames((3,), np.array([0.3]), np.eye(4)[None], deviation, deviation)

    monkeypatch.setattr(completion, "place_lost", found)
    lost = LostFrames(video, views, trajectory, range(4), trajectory, 0)
    around = lost._find(lost.known, [3], lambda *_: None)
    assert around.position == pytest.approx(times * 1e-5)
    for frame, read in zip(given, video, strict=True):
        np.testing.assert_array_equal(frame.image, views.alike(frame.index, read.image))
        assert np.array_equal(frame.image, read.image) == (frame.index in (0, 3))
    assert around.rotation == pytest.approx(np.sqrt(2) * 0.03)


@pytest.mark.system
def test_lost_frames_are_placed_and_those_of_another_room_are_not():
    pytest.importorskip("pycolmap")
    room, elsewhere = render_room(9, 3, 240, 180), lit_room(0)
    there = handheld_trajectory(elsewhere.scene, 120, 8)[:9:3]
    others = [elsewhere.render(room.camera, T).image for T in there]
    images = [*room.images, *others, np.zeros_like(room.images[0])]
    frames = [Frame(k, k / 10, image) for k, image in enumerate(images)]
    poses = [room.T_cw[k] if k < 6 else None for k in range(len(frames))]
    found = place_lost(
        frames, poses, as_seen(StraightView(room.camera, room.camera)), 0, lambda *_: None
    )
    assert found.numbers == (6, 7, 8)
    centres = np.linalg.inv(found.T_cw)[:, :3, 3]
    extent = np.linalg.norm(room.T_wc[:9, :3, 3] - room.T_wc[0, :3, 3], axis=1).max()
    off = np.linalg.norm(centres - room.T_wc[6:9, :3, 3], axis=1)
    assert off.max() < 0.02 * extent
    assert np.isfinite(found.position).all()
    assert found.position.max() < 0.05 * extent
    assert not len(
        place_lost(
            frames[:3],
            [None] * 3,
            as_seen(StraightView(room.camera, room.camera)),
            0,
            lambda *_: None,
        )
    )
