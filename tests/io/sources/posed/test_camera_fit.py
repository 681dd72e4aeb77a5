"""The camera by matches between posed images, against synthetic matches and a slow reference."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs.geometry.camera import Camera
from geogs.geometry.epipolar import epipolar_distance
from geogs.io.sources.posed.camera_fit import Lens, fitted, searched, stacked
from geogs.io.sources.posed.matching import MatchedPair

CAMERA = Camera(300.0, 300.0, 319.5, 239.5, 640, 480)


def scene(seed, focal=300.0, aspect=1.0, k1=0.0, noise=0.1, pairs=12, forward=False):
    """World-to-camera poses and noisy matches of a lens whose rays bend by k1."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-4, -3, 2], [4, 3, 9], (4000, 3))
    T_cw = np.tile(np.eye(4), (pairs + 1, 1, 1))
    step = np.array([0.0, 0.0, 0.15]) if forward else np.array([0.12, 0.05, 0.02])
    for k in range(pairs + 1):
        turn = Rotation.from_rotvec(rng.normal(0, 0.03, 3)).as_matrix()
        T_cw[k, :3, :3] = turn
        T_cw[k, :3, 3] = -turn @ (k * step)
    found = []
    for k in range(pairs):
        seen = []
        for T in T_cw[k : k + 2]:
            x = points @ T[:3, :3].T + T[:3, 3]
            plane = distorted(x[:, :2] / x[:, 2:], k1)
            pixels = plane * (focal, focal * aspect) + (CAMERA.cx, CAMERA.cy)
            inside = (x[:, 2] > 0.2) & ((pixels >= 0) & (pixels <= (639, 479))).all(axis=1)
            seen.append((pixels + rng.normal(0, noise, pixels.shape), inside))
        both = np.flatnonzero(seen[0][1] & seen[1][1])[:150]
        found.append(MatchedPair(k, k + 1, seen[0][0][both], seen[1][0][both]))
    return T_cw, found


def distorted(straight, k1):
    """The point whose straightening x (1 + k1 r^2) is given, by a fixed point."""
    bent = straight.copy()
    for _ in range(60):
        bent = straight / (1 + k1 * (bent**2).sum(axis=1, keepdims=True))
    return bent


def test_errors_are_the_sampson_distance():
    T_cw, pairs = scene(0, noise=2.0)
    matches = stacked(pairs, CAMERA)
    errors = matches.errors(matches.relative(T_cw), Lens(300.0))
    slow = []
    for pair in pairs:
        T = T_cw[pair.second] @ np.linalg.inv(T_cw[pair.first])
        one, two = (np.c_[p, np.ones(len(p))] for p in (pair.pixels_first, pair.pixels_second))
        slow.append(epipolar_distance(T, np.linalg.inv(CAMERA.K), one, two))
    np.testing.assert_allclose(np.abs(errors), np.concatenate(slow), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("focal", [180.0, 300.0, 900.0])
@pytest.mark.parametrize("forward", [False, True])
def test_the_focal_length_is_found_from_nothing(focal, forward):
    errors = []
    for seed in range(4):
        T_cw, pairs = scene(seed, focal, forward=forward)
        matches = stacked(pairs, CAMERA)
        found = searched(matches, matches.relative(T_cw))
        assert found.lens.focal == pytest.approx(focal, rel=0.02)
        errors.append(np.log(found.lens.focal / focal) / found.deviations[0])
    assert 0.2 < np.sqrt(np.mean(np.square(errors))) < 2.5


def test_aspect_and_distortion_are_found():
    T_cw, pairs = scene(1, 300.0, aspect=0.75)
    matches = stacked(pairs, CAMERA)
    T = matches.relative(T_cw)
    assert fitted(matches, T, Lens(300.0), (0, 1)).lens.aspect == pytest.approx(0.75, abs=0.004)
    T_cw, pairs = scene(2, 300.0, k1=0.25)
    matches = stacked(pairs, CAMERA)
    found = fitted(matches, matches.relative(T_cw), Lens(280.0), (0, 2, 3))
    assert found.lens.focal == pytest.approx(300.0, rel=0.01)
    rays = found.lens.rays(np.array([[200.0, 150.0]]))[0, :2]
    plane = np.array([200.0, 150.0]) / 300.0
    np.testing.assert_allclose(rays, plane * (1 + 0.25 * plane @ plane), rtol=0.01)


def test_a_turning_camera_does_not_tell_the_focal_length_by_its_translation():
    T_cw, pairs = scene(3, 300.0, noise=0.5)
    T_cw[:, :3, 3] = np.random.default_rng(0).normal(0, 1, (len(T_cw), 3))  # wrong directions
    matches = stacked(pairs, CAMERA)
    found = searched(matches, matches.relative(T_cw))
    errors = np.abs(matches.errors(matches.relative(T_cw), found.lens))
    assert np.median(errors) > 2 or found.deviations[0] > 0.03
