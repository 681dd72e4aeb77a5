"""Frames without a place are found about those that have one; what contradicts them is not."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs.application.structure_from_motion.completion import about, as_seen
from geogs.types import FoundFrames, FoundLens, Frame, Uncertainty
from geogs_photos.completion import place_lost
from geogs_photos.epipolar_agreement import epipolar_distance
from geogs_synth.motion.handheld import handheld_trajectory
from lit_rooms import lit_room
from posed_layouts import render_room


def test_the_distance_of_matches_is_to_first_order_how_far_they_move():
    """Against the least move of both points of a match, by Newton's method on the constraint."""
    random = np.random.default_rng(0)
    R, t = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix(), np.array([0.3, 0.1, -0.2])
    points = random.uniform([-1, -1, 2], [1, 1, 5], (20, 3))
    moved = points @ R.T + t
    first = points[:, :2] / points[:, 2:]
    second = moved[:, :2] / moved[:, 2:] + random.normal(scale=1e-3, size=(20, 2))
    E = np.cross(np.eye(3), t).T @ R
    for x, y, found in zip(first, second, epipolar_distance(first, second, R, t), strict=True):
        four = np.concatenate([x, y])
        for _ in range(20):
            a, b = np.append(four[:2], 1), np.append(four[2:], 1)
            slope = np.concatenate([(E.T @ b)[:2], (E @ a)[:2]])
            off = b @ E @ a + slope @ (np.concatenate([x, y]) - four)
            four = np.concatenate([x, y]) - off * slope / (slope @ slope)
        assert found == pytest.approx(np.linalg.norm(four - np.concatenate([x, y])), rel=0.02)


def test_cameras_in_one_place_are_told_by_the_rotation():
    R = Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix()
    ray = R @ np.array([0.1, 0.2, 1.0])
    second = ray[:2] / ray[2] + np.array([0.01, 0.0])
    off = epipolar_distance(np.array([[0.1, 0.2]]), second[None], R, np.zeros(3))
    assert off == pytest.approx(0.01)


def test_the_nearest_known_frames_on_both_sides():
    known = [*range(0, 60, 2), 90]
    assert about([31], known) == {*range(12, 52, 2)}
    assert about([100], known) == {*range(42, 60, 2), 90}
    assert about([3], []) == set()


def test_a_lens_that_was_found_since_is_in_the_calibration():
    camera = render_room(1, 1, 32, 24).camera
    bent = as_seen(camera, FoundLens(0.1, -0.2, 0.01, 0.01, 1.02))
    assert bent.fx == pytest.approx(1.02 * camera.fx)
    assert bent.distortion == (0.1, -0.2, 0.0, 0.0)
    assert as_seen(camera, None).distortion == ()


def test_what_is_found_is_as_unsure_as_what_is_around_and_by_itself():
    known = Uncertainty(np.array([0.0, 2.0]), *(np.array([3.0, 3.0]) for _ in range(3)))
    found = FoundFrames((1,), np.array([1.0]), np.eye(4)[None], np.array([4.0]), np.array([4.0]))
    both = known.with_found(found)
    np.testing.assert_allclose(both.timestamps, [0, 1, 2])
    np.testing.assert_allclose(both.position, [3, 5, 3])
    np.testing.assert_allclose(both.rotation, [3, 5, 3])
    np.testing.assert_allclose(both.depth, 3)


@pytest.mark.system
def test_lost_frames_are_placed_and_those_of_another_room_are_not():
    pytest.importorskip("pycolmap")
    room, elsewhere = render_room(9, 3, 320, 240), lit_room(8)
    there = handheld_trajectory(elsewhere.scene, 120, 8)[:9:3]
    others = [elsewhere.render(room.camera, T).image for T in there]
    images = [*room.images, *others, np.zeros_like(room.images[0])]
    frames = [Frame(k, k / 10, image) for k, image in enumerate(images)]
    poses = [room.T_cw[k] if k < 6 else None for k in range(len(frames))]
    reports: list[float] = []
    found = place_lost(frames, poses, as_seen(room.camera, None), 0, reports.append)
    assert found.numbers == (6, 7, 8)
    assert reports == sorted(reports)
    centres = np.linalg.inv(found.T_cw)[:, :3, 3]
    extent = np.linalg.norm(room.T_wc[:9, :3, 3] - room.T_wc[0, :3, 3], axis=1).max()
    off = np.linalg.norm(centres - room.T_wc[6:9, :3, 3], axis=1)
    assert off.max() < 0.02 * extent
    assert np.isfinite(found.position).all()
    assert found.position.max() < 0.05 * extent
    assert not len(place_lost(frames[:3], [None] * 3, as_seen(room.camera, None), 0, print))
