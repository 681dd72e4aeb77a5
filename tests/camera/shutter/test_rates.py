"""Angular velocity from flow: known rotations of a rendered room, and of rays."""

from dataclasses import replace

import numpy as np
import pytest

from geogs.camera.shutter.angular_motion import rotated
from geogs.camera.shutter.rates import (
    FlowMeter,
    RayFlow,
    angular_velocity,
    parallax,
    with_angular_motion,
)
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.geometry.camera import Camera
from rolling_scenes import (
    RATE,
    READOUT,
    global_image,
    hand_held,
    rolling_frames,
    rolling_image,
    turning,
)
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
    return RayFlow(
        first, second, first_time, second_time, np.ones(400, bool), np.zeros((400, 2)), (20, 20)
    )


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


def test_parallax_is_what_cells_move_beside_the_rotation():
    """A rotation, and beside it a drift that grows downwards as over a floor; some cells fail."""
    camera = RollingCamera(Camera(200.0, 200.0, 127.5, 95.5, 256, 192))
    v, u = np.mgrid[4:192:8, 4:256:8]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    first, interval = camera.rays(pixels), 1 / RATE
    drift = np.stack([0.3 + 0.5 * pixels[:, 1] / 192, np.full(len(pixels), -0.1)], axis=1)
    turned = rotated(first, np.repeat(interval * TURN[None], len(first), axis=0))
    plane = turned[:, :2] / turned[:, 2:] + interval * drift
    second = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    times = np.zeros(len(first))
    inside = np.ones(len(first), bool)
    inside[::17] = False
    second[::17] += 0.1
    flow = RayFlow(first, second, times, times, inside, camera.pixels(second), v.shape)
    here, there = parallax(flow, TURN, interval, READOUT)
    inner = np.s_[3:-3, 3:-3]
    np.testing.assert_allclose(here[inner], drift.reshape(*v.shape, 2)[inner], atol=0.03)
    np.testing.assert_allclose(there[inner].mean((0, 1)), drift.mean(0), atol=0.05)


ROLLING = RollingCamera(CAMERA)


@pytest.fixture(scope="module")
def video():
    return rolling_frames(hand_held, 7)


def turnings(frames, wanted=lambda position: True):
    return {
        frame.index: np.concatenate([turning.rate, turning.acceleration])
        for frame, turning in with_angular_motion(frames, ROLLING, READOUT, wanted)
    }


def test_ends_have_one_side_and_others_the_mean_of_both(video):
    found = turnings(video)
    assert list(found) == list(range(7))
    first, second = found[0][:3], 2 * found[1][:3] - found[0][:3]
    np.testing.assert_allclose(found[1][3:], (second - first) * RATE, atol=1e-6)
    assert not found[0][3:].any()
    assert not found[6][3:].any()
    assert np.linalg.norm(found[3][:3]) > 0.3


def test_what_is_found_does_not_depend_on_where_reading_begins(video):
    whole = turnings(video)
    later = turnings(video[2:], lambda position: position > 0)
    assert list(later) == [3, 4, 5, 6]
    every_other = turnings(video, lambda position: position % 3 == 1)
    assert list(every_other) == [1, 4]
    for part in (later, every_other):
        for index, found in part.items():
            np.testing.assert_array_equal(found, whole[index])


def test_beside_an_image_that_cannot_be_read_the_other_side_tells(video):
    class Missing:
        index, timestamp, image = 3, video[3].timestamp, None

    whole = turnings(video)
    found = turnings([*video[:3], Missing(), *video[4:]])
    assert list(found) == list(range(7))
    assert not found[3].any()
    assert not found[2][3:].any()
    np.testing.assert_array_equal(found[1], whole[1])
    np.testing.assert_array_equal(found[5], whole[5])


def test_images_of_the_same_time_tell_nothing(video):
    frozen = [replace(video[0], index=k, timestamp=0.0) for k in range(3)]
    assert not any(t.any() for t in turnings(frozen).values())
    assert turnings([]) == {}
    assert not turnings(video[:1])[0].any()
