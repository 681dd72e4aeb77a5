"""Rotation of rays, and the turning between two steps of a video."""

import numpy as np
import torch

from geogs.camera.shutter.angular_motion import (
    AngularMotion,
    AngularStep,
    angular_motion_between,
    rotated,
)
from geogs.camera.shutter.turning_kernels import nearest_turn
from geogs.geometry.lie import so3_exp
from geogs.geometry.nearest_rotation import nearest_rotation


def test_vectors_are_rotated_as_by_the_matrix_exponential():
    rng = np.random.default_rng(0)
    vectors, by = rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    by[0], by[1] = 0.0, 1e-9
    expected = [so3_exp(torch.tensor(b)).numpy() @ v for v, b in zip(vectors, by, strict=True)]
    np.testing.assert_allclose(rotated(vectors, by), expected, atol=1e-12)


def test_the_nearest_rotation_is_that_of_the_singular_vectors():
    """Moments whose singular values span three orders, as of a narrow cone; no mirror images."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        frame, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        moment = 500 * rng.normal(size=(3, 3)) @ np.diag([1, 0.1, 1e-3]) @ frame
        moment *= np.sign(np.linalg.det(moment))
        expected = nearest_rotation(moment)
        assert nearest_turn(moment)
        np.testing.assert_allclose(moment, expected, atol=1e-9)
    assert not nearest_turn(np.zeros((3, 3)))
    assert not nearest_turn(np.diag([1.0, 1.0, -1.0]))


def test_a_linear_rate_is_found_from_its_means():
    """Steps of different length: the means of a rate a + b t are its values in their middles."""
    a, b = np.array([0.3, -0.2, 0.1]), np.array([4.0, 5.0, -6.0])
    turning = angular_motion_between(
        AngularStep(a - 0.02 * b, 0.04), AngularStep(a + 0.01 * b, 0.02)
    )
    np.testing.assert_allclose(turning.rate, a, atol=1e-12)
    np.testing.assert_allclose(turning.acceleration, b, atol=1e-9)
    np.testing.assert_allclose(
        turning.angles(np.array([0.0, 0.1])), [np.zeros(3), 0.1 * a + 0.005 * b], atol=1e-12
    )


def test_at_an_end_the_only_step_tells_and_without_one_the_camera_stands():
    rate = np.array([0.1, 0.2, 0.3])
    for known in ((AngularStep(rate, 0.03), None), (None, AngularStep(rate, 0.03))):
        turning = angular_motion_between(*known)
        np.testing.assert_array_equal(turning.rate, rate)
        assert not turning.acceleration.any()
        assert not turning.is_still
    assert angular_motion_between(None, None).is_still
    assert AngularMotion().is_still
