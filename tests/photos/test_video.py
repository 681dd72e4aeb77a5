"""Frames of a video that are placed without tracking."""

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geogs.application.structure_from_motion.chosen_frames import ChosenFrames
from geogs.application.structure_from_motion.photos import PlacedVideo
from geogs.geometry.umeyama import umeyama
from geogs.io.sources.calibration import Calibration
from geogs.types import Frame
from geogs_photos.incremental_mapping import adjust, placed_images
from geogs_photos.localise import Localiser, matches_to_points
from geogs_photos.photo_features import find_features
from geogs_photos.video import place_frames, with_rows_at_once
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
@pytest.mark.long
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


def zoomed(image: np.ndarray, factor: float) -> np.ndarray:
    """The middle of an image, as large as it was."""
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0.0, factor)
    return cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_CUBIC)


@pytest.mark.system
@pytest.mark.parametrize(
    ("last", "is_known"), [pytest.param(1.0, True, marks=pytest.mark.long), (1.5, False)]
)
@pytest.mark.long
def test_frames_of_a_zoom_have_no_place_that_counts(last, is_known):
    pytest.importorskip("pycolmap")
    room = render_room(14, 3, 240, 180)
    factors = np.where(np.arange(14) < 7, 1.0, last)
    images = [zoomed(image, f) for image, f in zip(room.images, factors, strict=True)]
    frames = tuple(Frame(k, k / 10, image) for k, image in enumerate(images))
    chosen = ChosenFrames(frames, np.arange(14) / 10)
    placed = place_frames(chosen, room.camera, False, False, False, 0, lambda *_: None)
    assert len(placed.numbers) >= 12
    assert np.isfinite(placed.deviation).all() == is_known


FRAMES, STEP, HEIGHT = 12, 0.2, 240


def pose(time: float) -> np.ndarray:
    """World to camera on an arc about what is seen."""
    T = np.eye(4)
    turn = [0.2 * np.sin(2.0 * time), 0.5 * np.sin(time), 0.0]
    T[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    T[:3, 3] = 0.5 * np.sin(1.3 * time), 0.1 * np.sin(time), 4.0
    return T


def seen(points: np.ndarray, time: float, readout: float) -> np.ndarray:
    """Pixels, each at the time of its row."""
    pixels = np.full((len(points), 2), HEIGHT / 2)
    for _ in range(8):
        times = time + readout * (pixels[:, 1] / HEIGHT - 0.5)
        local = np.stack(
            [T[:3, :3] @ p + T[:3, 3] for p, T in zip(points, map(pose, times), strict=True)]
        )
        pixels = 250 * local[:, :2] / local[:, 2:] + [160, 120]
    return pixels


@pytest.mark.parametrize(("readout", "better"), [(0.02, 4.0), (0.0, 0.0)])
def test_the_readout_is_found_and_poses_with_it(readout, better):
    colmap = pytest.importorskip("pycolmap")
    random = np.random.default_rng(0)
    points, times = random.uniform(-1.2, 1.2, (150, 3)), STEP * np.arange(FRAMES)
    model = colmap.Reconstruction()
    camera = colmap.Camera(
        model=colmap.CameraModelId.PINHOLE, width=320, height=HEIGHT, camera_id=1,
        params=[250.0, 250.0, 160.0, 120.0],
    )  # fmt: skip
    model.add_camera_with_trivial_rig(camera)
    for k, time in enumerate(times):
        pixels = seen(points, time, readout) + random.normal(0, 0.01, (len(points), 2))
        image = colmap.Image(f"{k:06d}", [colmap.Point2D(p) for p in pixels], 1, k + 1)
        model.add_image_with_trivial_frame(image, colmap.Rigid3d(pose(time)[:3]))
    for n, point in enumerate(points):
        track = colmap.Track()
        for k in range(FRAMES):
            track.add_element(k + 1, n)
        model.add_point3D(point, track)

    def off(some) -> float:
        centres = torch.from_numpy(np.stack([i.projection_center() for i in placed_images(some)]))
        truth = torch.from_numpy(np.stack([np.linalg.inv(pose(t))[:3, 3] for t in times]))
        scale, R, t = umeyama(centres, truth)
        return float((scale * centres @ R.T + t - truth).norm(dim=1).mean())

    adjust(model, {1})
    found, unsure = with_rows_at_once(model, times, {1})
    assert off(found) * better <= off(model)
    assert off(found) < 4e-4
    assert unsure.shape == (FRAMES,)
    assert unsure.mean() > 0.1 * off(model) if readout else unsure.max() < 1e-4
