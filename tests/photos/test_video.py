"""Frames of a video that are placed without tracking."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs.application.structure_from_motion.chosen_frames import ChosenFrames
from geogs.application.structure_from_motion.photos import PlacedVideo
from geogs.io.sources.calibration import Calibration
from geogs.types import Frame
from geogs_photos.localise import Localiser, matches_to_points
from geogs_photos.photo_features import find_features
from geogs_photos.video import place_frames
from lit_rooms import lit_room
from posed_layouts import render_room


def test_a_point_seen_twice_does_not_compete_with_itself():
    random = np.random.default_rng(0)
    looks = random.integers(0, 120, (20, 128), dtype=np.uint8)
    positions = random.normal(size=(20, 3))
    twice = np.concatenate([looks, looks ^ 1])
    own, known = matches_to_points(looks[::-1].copy(), twice, np.tile(positions, (2, 1)))
    assert len(own) == 20
    np.testing.assert_allclose(np.tile(positions, (2, 1))[known], positions[::-1])
    # Another point that looks the same does.
    own, _ = matches_to_points(looks[:1] ^ 2, twice[[0, 20]], random.normal(size=(2, 3)))
    assert not len(own)


@pytest.mark.system
def test_a_frame_is_placed_against_points():
    """Points of the truth with the looks that two frames give them; a third frame is placed."""
    pytest.importorskip("pycolmap")
    room = render_room(3, 2, 320, 240)

    raycaster = lit_room(3)
    positions, looks = [], []
    for k in (0, 2):
        depth = raycaster.render(room.camera, room.T_wc[k]).depth
        features = find_features(room.images[k])
        u, v = features.keypoints[:, :2].T
        z = depth[v.round().astype(int).clip(0, 239), u.round().astype(int).clip(0, 319)]
        c = room.camera
        local = np.stack([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z], -1)
        local = local[z > 0].astype(np.float64)
        positions.append(local @ room.T_wc[k, :3, :3].T + room.T_wc[k, :3, 3])
        looks.append(features.descriptors[z > 0])
    video = PlacedVideo(
        np.arange(3.0), 2, (0, 2), room.T_cw[[0, 2]], *np.zeros((3, 2)), tuple(positions),
        tuple(looks), Calibration(c.fx, c.fy, c.cx, c.cy), 0.0,
    )  # fmt: skip
    localiser = Localiser(video, room.camera, 0)
    T_cw = localiser.place(Frame(1, 1.0, room.images[1]))
    assert T_cw is not None
    off = np.linalg.inv(T_cw) @ room.T_cw[1]
    assert np.linalg.norm(off[:3, 3]) < 0.01
    assert Rotation.from_matrix(off[:3, :3]).magnitude() < np.radians(0.2)
    assert localiser.place(Frame(1, 1.0, np.zeros_like(room.images[1]))) is None


@pytest.mark.system
def test_deviations_hold_what_the_truth_is_off():
    pytest.importorskip("pycolmap")
    room = render_room(9, 3, 240, 180)
    frames = [Frame(k, k / 10, image) for k, image in enumerate(room.images)]
    chosen = ChosenFrames(tuple(frames), np.arange(9) / 10)
    placed = place_frames(chosen, room.camera, True, False, False, 0, lambda *_: None)
    assert placed.numbers == tuple(range(9))
    centres, truth = np.linalg.inv(placed.T_cw)[:, :3, 3], room.T_wc[:, :3, 3]
    one, other = (np.linalg.norm(c - c[0], axis=1) for c in (centres, truth))
    scale = other.sum() / one.sum()
    off = np.abs(scale * one - other)
    assert off.max() < 0.02 * other.max()
    assert np.isfinite(placed.deviation).all()
    assert 0 < np.median(placed.depth) < 0.1
    assert scale * placed.deviation.max() < 0.05 * other.max()


@pytest.mark.system
def test_a_focal_length_that_contradicts_the_one_the_video_told_leaves_all_unknown():
    pytest.importorskip("pycolmap")
    room = render_room(9, 3, 240, 180)
    frames = [Frame(k, k / 10, image) for k, image in enumerate(room.images)]
    chosen = ChosenFrames(tuple(frames), np.arange(9) / 10)
    for told, is_believed in ((1.02, True), (1.3, False)):
        camera = room.camera.with_focal(told * room.camera.fx)
        placed = place_frames(chosen, camera, False, True, False, 0, lambda *_: None)
        assert placed.calibration.fx == pytest.approx(room.camera.fx, rel=0.03)
        for known in (placed.deviation, placed.rotation, placed.depth):
            assert bool(np.isfinite(known).all()) is is_believed
