"""Deviations against random poses that are aligned one by one."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geogs.geometry.umeyama import umeyama
from geogs_photos import deviations
from geogs_photos.completion import deviations_by_part
from geogs_photos.deviations import pose_deviations, without_gauge
from geogs_photos.incremental_mapping import placed_images, world_to_camera


def test_against_samples_that_are_aligned():
    random = np.random.default_rng(0)
    count = 6
    T_cw = np.tile(np.eye(4), (count, 1, 1))
    T_cw[:, :3, :3] = Rotation.random(count, rng=random).as_matrix()
    T_cw[:, :3, 3] = random.normal(size=(count, 3))
    root = 1e-4 * random.normal(size=(6 * count, 6 * count))
    place, _ = without_gauge(root @ root.T, T_cw)
    centres = -np.einsum("nij,ni->nj", T_cw[:, :3, :3], T_cw[:, :3, 3])
    squares = np.zeros(count)
    for _ in range(400):
        x = (root @ random.normal(size=6 * count)).reshape(count, 6)
        R = Rotation.from_rotvec(x[:, :3]).as_matrix() @ T_cw[:, :3, :3]
        moved = -np.einsum("nij,ni->nj", R, T_cw[:, :3, 3] + x[:, 3:])
        pair = map(torch.from_numpy, (moved, centres))
        scale, turn, shift = (v.numpy() for v in umeyama(*pair))
        squares += ((scale * moved @ turn.T + shift - centres) ** 2).sum(1)
    assert place == pytest.approx(np.sqrt(squares / 400), rel=0.15)


def test_what_hangs_on_at_an_end_sways_with_what_it_hangs_on():
    """Six cameras of which four are fitted: the others turn and grow with these."""
    random = np.random.default_rng(2)
    T_cw = np.tile(np.eye(4), (6, 1, 1))
    T_cw[:, :3, 3] = random.normal(size=(6, 3))
    T_cw[4:, :3, 3] += 10.0
    root = 1e-4 * random.normal(size=(36, 36))
    root[24:] = 0  # nothing is unsure about the last two but for the world of the others
    fitted = np.arange(6) < 4
    place, _ = without_gauge(root @ root.T, T_cw, [range(4)] * 6)
    centres, squares = -T_cw[:, :3, 3], np.zeros(6)
    for _ in range(400):
        x = (root @ random.normal(size=36)).reshape(6, 6)
        R = Rotation.from_rotvec(x[:, :3]).as_matrix()
        moved = -np.einsum("nij,ni->nj", R, T_cw[:, :3, 3] + x[:, 3:])
        pair = (torch.from_numpy(c[fitted]) for c in (moved, centres))
        scale, turn, shift = (v.numpy() for v in umeyama(*pair))
        squares += ((scale * moved @ turn.T + shift - centres) ** 2).sum(1)
    assert place == pytest.approx(np.sqrt(squares / 400), rel=0.15)
    assert place[4:].min() > place[:4].max()


def test_a_similarity_of_the_world_is_no_deviation():
    T_cw = np.tile(np.eye(4), (4, 1, 1))
    T_cw[:, :3, 3] = np.random.default_rng(1).normal(size=(4, 3))
    # dt = -R d moves every centre by d.
    common = np.tile([0, 0, 0, 1.0, 2.0, 3.0], 4)
    place, turn = without_gauge(np.outer(common, common), T_cw)
    assert place.max() < 1e-6
    assert turn.max() < 1e-6


def test_what_hangs_on_at_either_end_is_told_beside_that_end():
    """Two walks that hardly see each other, and a camera found at either: each sample has its own
    noise, is adjusted by dense least squares over poses and points, and laid over the truth by the
    four known cameras of one walk."""
    random = np.random.default_rng(5)
    walk = np.repeat([0, 1], 5)
    T_cw = np.tile(np.eye(4), (10, 1, 1))
    T_cw[:, :3, :3] = Rotation.from_rotvec(0.05 * random.normal(size=(10, 3))).as_matrix()
    T_cw[:, :3, 3] = 0.1 * random.normal(size=(10, 3)) - [0.3, 0, 0] * np.arange(10)[:, None]
    points = random.uniform((-2, -1, 3), (3, 1, 5), (24, 3))
    sigma = np.where(walk[:, None] == np.repeat([0, 1], 12), 1e-6, 1e-3).repeat(2)

    def moved_by(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        w, t = x[:60].reshape(10, 6)[:, :3], x[:60].reshape(10, 6)[:, 3:]
        return Rotation.from_rotvec(w).as_matrix() @ T_cw[:, :3, :3], T_cw[:, :3, 3] + t

    def seen(x: np.ndarray) -> np.ndarray:
        R, t = moved_by(x)
        at = np.einsum("nij,kj->nki", R, points + x[60:].reshape(-1, 3)) + t[:, None]
        return (at[..., :2] / at[..., 2:]).reshape(-1)

    steps = 1e-6 * np.eye(60 + points.size)
    J = np.stack([seen(e) - seen(-e) for e in steps], 1) / 2e-6
    free = np.setdiff1d(np.arange(len(steps)), 60 + np.array([0, 1, 2, 3, 4, 5, 8]))  # any gauge
    solver = np.zeros((len(steps), len(J)))
    solver[free] = np.linalg.pinv(J[:, free] / sigma[:, None]) / sigma
    joint = (solver[:60] * sigma**2) @ solver[:60].T
    known = np.array([0, 1, 2, 3, 6, 7, 8, 9])
    own = [known[walk[known] == w].tolist() for w in walk]
    place, turn = without_gauge(joint, T_cw, own)
    truth = -np.einsum("nij,ni->nj", T_cw[:, :3, :3], T_cw[:, :3, 3])
    squares, turned = np.zeros(10), np.zeros(10)
    for _ in range(400):
        R, t = moved_by(solver @ (sigma * random.normal(size=len(J))))
        centres = -np.einsum("nij,ni->nj", R, t)
        axes = Rotation.from_matrix(np.einsum("nji,njk->nik", R, T_cw[:, :3, :3])).as_rotvec()
        for w in (0, 1):
            fitted = known[walk[known] == w]
            pair = (torch.from_numpy(c[fitted]) for c in (centres, truth))
            scale, turn_back, shift = (v.numpy() for v in umeyama(*pair))
            off = scale * centres @ turn_back.T + shift - truth
            squares[walk == w] += np.square(off[walk == w]).sum(1)
            turned[walk == w] += np.square(axes - axes[fitted].mean(0))[walk == w].sum(1)
    assert place == pytest.approx(np.sqrt(squares / 400), rel=0.15)
    assert turn == pytest.approx(np.sqrt(turned / 400), rel=0.15)
    together, _ = without_gauge(joint, T_cw, [known.tolist()] * 10)
    assert (together > 10 * place).all()


def test_a_covariance_that_overflows_tells_nothing(monkeypatch):
    """Nor does anything warn of it, which would fail here."""
    pytest.importorskip("pycolmap")
    block = np.full((6, 6), np.inf)
    overflown = SimpleNamespace(
        get_cam_cov_from_world=lambda one: block,
        get_cam_cross_cov_from_world=lambda one, other: block,
    )
    monkeypatch.setattr(deviations, "_covariance", lambda *given: overflown)
    images = [SimpleNamespace(image_id=n) for n in range(4)]
    T_cw = np.tile(np.eye(4), (4, 1, 1))
    model = SimpleNamespace(compute_mean_reprojection_error=lambda: 0.5)
    monkeypatch.setattr(deviations, "_evidence", lambda *given: model)
    for known in pose_deviations(model, images, T_cw, False):
        np.testing.assert_array_equal(known, np.inf)


def walks(*starts: float) -> Any:
    """A reconstruction of walks of six pictures each, none of which sees what another does."""
    colmap, random = pytest.importorskip("pycolmap"), np.random.default_rng(3)
    model = colmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        colmap.Camera(model="SIMPLE_PINHOLE", width=400, height=300, params=[300, 200, 150],
                      camera_id=1)
    )  # fmt: skip
    for walk, start in enumerate(starts):
        points = random.uniform((start - 1, -1, 3), (start + 1, 1, 6), (40, 3))
        numbers = range(6 * walk + 1, 6 * walk + 7)
        for k, number in enumerate(numbers):
            centre = np.array([start + 0.1 * k, 0.02 * k * k, 0.0])
            seen = (points - centre)[:, :2] / points[:, 2:] * 300 + (200, 150)
            seen = [*(seen + random.normal(0, 0.3, seen.shape)), np.full(2, 100.0)]
            image = colmap.Image(f"{number:02d}", seen, camera_id=1, image_id=number)
            pose = np.hstack([np.eye(3), -centre[:, None]])
            model.add_image_with_trivial_frame(image, colmap.Rigid3d(pose))
        for n, point in enumerate(points):
            track = colmap.Track([colmap.TrackElement(k, n) for k in numbers])
            add_point(model, point, track)
    return model


def add_point(model: Any, at: np.ndarray, track: Any) -> None:
    model.points3D[model.add_point3D(at, track, np.zeros(3, np.uint8))].error = 0.3


def told_of(model: Any, numbers: range) -> tuple[np.ndarray, np.ndarray]:
    images = [image for image in placed_images(model) if image.image_id in numbers]
    return pose_deviations(model, images, np.stack([*map(world_to_camera, images)]), True)


def test_a_point_in_the_centre_of_a_camera_says_nothing():
    model = walks(0)
    before = told_of(model, range(1, 7))
    assert np.isfinite(before).all()
    colmap = pytest.importorskip("pycolmap")
    for away in (1e-10, 0.03):
        at = model.images[2].projection_center() + np.array([0, 0, away])
        track = colmap.Track([colmap.TrackElement(k, 40) for k in (2, 4)])
        trial = colmap.Reconstruction(model)
        add_point(trial, at, track)
        np.testing.assert_allclose(told_of(trial, range(1, 7)), before)


def test_frames_found_at_either_end_are_told_by_what_is_known_there():
    """Matches do not say how the ends lie to each other, and all together have no covariance."""
    model = walks(0, 30)
    images = placed_images(model)
    is_known = np.array([k % 3 > 0 for k in range(12)])
    position, rotation = deviations_by_part(model, images, is_known)
    for walk in (range(6), range(6, 12)):
        own = [images[k] for k in walk]
        beside = [[k for k in range(6) if is_known[walk[k]]]] * 6
        poses = np.stack([*map(world_to_camera, own)])
        there = pose_deviations(model, own, poses, True, beside)
        assert np.isfinite(there).all()
        np.testing.assert_allclose((position[walk], rotation[walk]), there)
    unknown, _ = deviations_by_part(model, images, np.arange(12) < 6)
    np.testing.assert_array_equal(np.isfinite(unknown), np.arange(12) < 6)
