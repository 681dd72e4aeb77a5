"""Angular velocity from flow: known rotations of a rendered room, and of rays."""

from dataclasses import replace

import numpy as np
import pytest

from geogs.shutter.camera import RollingCamera
from geogs.shutter.rates import FlowMeter, RayFlow, angular_velocity
from geogs.shutter.turning import rotated
from rolling_scenes import RATE, READOUT, global_image, rolling_image, turning
from tracking_scenes import CAMERA

TURN = np.array([0.6, -0.9, 0.4])
"""Radians per second."""


def measured(images) -> RayFlow:
    meter = FlowMeter(RollingCamera(CAMERA))
    return meter.measure(*(meter.small(image) for image in images))


def test_the_rotation_of_a_global_shutter_is_found():
    path = turning(TURN)
    flow = measured([global_image(path, k / RATE) for k in (0, 1)])
    rate = angular_velocity(flow, 1 / RATE, 0.0)
    np.testing.assert_allclose(rate, TURN, atol=0.02)  # a tenth of a pixel is 0.02 rad/s here
    still = measured([global_image(path, 0.0)] * 2)
    np.testing.assert_allclose(angular_velocity(still, 1 / RATE, 0.0), 0.0, atol=1e-3)


def test_the_time_between_two_rows_is_heeded():
    """Flow down the image ends in later rows: without the readout the rate comes out too low."""
    path = turning(TURN)
    flow = measured([rolling_image(path, k / RATE) for k in (0, 1)])
    true = np.linalg.norm(TURN)
    heeded = np.linalg.norm(angular_velocity(flow, 1 / RATE, READOUT))
    not_heeded = np.linalg.norm(angular_velocity(flow, 1 / RATE, 0.0))
    assert heeded == pytest.approx(true, rel=0.01)
    assert not_heeded / true < 0.99


def made_flow(outliers: int) -> RayFlow:
    """Rays of a rolling camera that only turns, exactly; the last ones of something that moves."""
    rng = np.random.default_rng(1)
    plane = rng.uniform(-0.5, 0.5, (400, 2))
    rays = np.concatenate([plane, np.ones((400, 1))], 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    first_time, second_time = rng.uniform(-0.5, 0.5, (2, 400))
    first = rotated(rays, READOUT * first_time[:, None] * TURN)
    second = rotated(rays, (READOUT * second_time[:, None] + 1 / RATE) * TURN)
    if outliers:
        second[-outliers:] = rotated(second[-outliers:], np.full((outliers, 3), 0.04))
    return RayFlow(first, second, first_time, second_time, np.ones(400, bool))


def test_exact_rays_give_the_exact_rate():
    rate = angular_velocity(made_flow(0), 1 / RATE, READOUT)
    np.testing.assert_allclose(rate, TURN, atol=1e-6)


def test_a_third_that_moves_does_not_matter():
    rate = angular_velocity(made_flow(130), 1 / RATE, READOUT)
    np.testing.assert_allclose(rate, TURN, atol=0.02)


def test_what_is_no_rotation_has_no_rate():
    flow = made_flow(0)
    scattered = np.random.default_rng(2).normal(size=flow.second.shape)
    scattered /= np.linalg.norm(scattered, axis=1, keepdims=True)
    assert angular_velocity(replace(flow, second=scattered), 1 / RATE, 0.0) is None
    assert angular_velocity(replace(flow, inside=np.zeros(400, bool)), 1 / RATE, 0.0) is None
    assert angular_velocity(flow, 0.0, 0.0) is None
