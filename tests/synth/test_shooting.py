"""Rolling rows, blur, movers and the sensor, each against the plain thing it is made of."""

import numpy as np
import pytest
import torch

from geogs.errors import InputError
from geogs_synth.camera.flaws import CameraKind, Flaws, camera_flaws
from geogs_synth.camera.radial_camera import RadialCamera
from geogs_synth.camera.sensors import ImageSensor
from geogs_synth.motion.room_motions import room_motion
from geogs_synth.places.moving_bodies import crossing_walkers
from geogs_synth.raycast.raycaster import Raycaster
from geogs_synth.scene.light_changes import LightChanges, switched_by_thirds
from geogs_synth.scene.textured_scene import Scene
from geogs_synth.sequence.location import centred_camera
from geogs_synth.sequence.shooting import Shooting
from lit_rooms import lit_room

CAMERA = centred_camera(96, 72)
LENS = RadialCamera(CAMERA)


@pytest.fixture(scope="module")
def raycaster() -> Raycaster:
    return lit_room(0)


@pytest.fixture(scope="module")
def scene(raycaster: Raycaster) -> Scene:
    return raycaster.scene


def _shooting(raycaster: Raycaster, flaws: Flaws, kind: str = "turning-60") -> Shooting:
    path = room_motion(kind, raycaster.scene).path
    return Shooting(raycaster, RadialCamera(CAMERA, flaws.k1, flaws.k2), path, flaws)


def test_rolling_rows_are_those_of_their_own_poses(raycaster: Raycaster) -> None:
    path = room_motion("turning-120", raycaster.scene).path
    times = 0.5 + (np.arange(72) / 71 - 0.5) * 0.03
    lens = RadialCamera(CAMERA, -0.2, 0.05)
    view = raycaster.render_rolling(lens, path(times), times)
    for row in (0, 1, 20, 36, 71):
        still = raycaster.render(lens, path(times[row : row + 1])[0])
        for name in ("image", "depth", "normal", "solid"):
            np.testing.assert_array_equal(getattr(view, name)[row], getattr(still, name)[row])
    ends = [raycaster.render(lens, path(times[k : k + 1])[0]).depth for k in (0, 71)]
    assert np.abs(view.depth - ends[0]).mean() > 0.01
    assert np.abs(view.depth - ends[1]).mean() > 0.01


def test_lamps_are_switched_by_thirds_and_change_the_light_alone(raycaster: Raycaster) -> None:
    """Light is a sum over the lamps, so one that is on alone tells what it gives."""
    lamps = len(raycaster.scene.lights)
    T_wc = room_motion("handheld", raycaster.scene).path(np.zeros(1))[0]
    changes = switched_by_thirds(lamps, 9.0)
    steady = raycaster.render(CAMERA, T_wc)
    switched = raycaster.with_lights(changes)
    first = switched.render(CAMERA, T_wc, 2.9)
    np.testing.assert_array_equal(first.image, steady.image)

    def light(gains: np.ndarray) -> np.ndarray:
        alone = LightChanges(np.zeros(0), gains[None])
        return (raycaster.with_lights(alone).render(CAMERA, T_wc).shade / 255.0) ** 2

    dark, each = light(np.zeros(lamps)), [light(row) for row in np.eye(lamps)]
    for time, gains in ((3.0, changes.gains[1]), (6.1, changes.gains[2])):
        view = switched.render(CAMERA, T_wc, time)
        expected = dark + sum(g * (e - dark) for g, e in zip(gains, each, strict=True))
        mild = expected < 0.9  # brighter pixels are clipped
        off = np.abs((view.shade / 255.0) ** 2 - expected)[mild]
        assert mild.mean() > 0.5
        assert np.median(off) < 1e-4
        assert np.abs(view.image.astype(float) - steady.image).mean() > 5
        np.testing.assert_array_equal(view.depth, steady.depth)


def test_rows_of_a_rolling_shutter_see_the_light_of_their_own_time(raycaster: Raycaster) -> None:
    path = room_motion("handheld", raycaster.scene).path
    times = 1.0 + (np.arange(72) / 71 - 0.5) * 0.03
    poses = np.repeat(path(np.ones(1)), 72, 0)
    switched = raycaster.with_lights(switched_by_thirds(len(raycaster.scene.lights), 3.0))
    view = switched.render_rolling(LENS, poses, times)
    for time, rows in ((0.9, slice(0, 36)), (1.1, slice(36, 72))):
        still = switched.render(LENS, poses[0], time)
        np.testing.assert_array_equal(view.image[rows], still.image[rows])


def test_row_times_follow_the_convention(raycaster: Raycaster) -> None:
    times = _shooting(raycaster, Flaws(readout=0.03)).row_times()
    np.testing.assert_allclose(times, [(v / 71 - 0.5) * 0.03 for v in range(72)], atol=1e-15)


def test_blur_is_the_mean_of_its_instants(raycaster: Raycaster) -> None:
    """In linear light; as many instants as the image moves by pixels, and one if it is still."""
    flaws = Flaws(exposure=0.03)
    shooting = _shooting(raycaster, flaws)
    path = room_motion("turning-60", raycaster.scene).path
    shot = shooting.shoot(4)
    times = shooting.sample_times(shot.truth, shot.T_wc, shot.time)
    # Just over 2 pixels at 60 degrees a second.
    assert len(times) == 5
    np.testing.assert_allclose(times.mean(), 4 / 30)
    np.testing.assert_allclose(np.diff(times), 0.006)
    light = sum((raycaster.render(LENS, path(times[k : k + 1])[0]).shade / 255) ** 2 / 5
                for k in range(5))  # fmt: skip
    assert np.abs(shot.image - 255 * np.sqrt(light)).max() < 0.51
    fast = _shooting(raycaster, Flaws(exposure=0.05), "turning-120").shoot(4)
    # 7 pixels in the middle of the image, half as many again at its sides.
    times = _shooting(raycaster, Flaws(exposure=0.05), "turning-120").sample_times(
        fast.truth, fast.T_wc, fast.time
    )
    assert 8 <= len(times) <= 13
    still = Shooting(raycaster, LENS, room_motion("still", raycaster.scene).path, flaws)
    np.testing.assert_array_equal(still.shoot(2).image, still.shoot(2).truth.image)


def test_rolling_blur_has_both(raycaster: Raycaster) -> None:
    """Every row is blurred about its own time."""
    flaws = Flaws(readout=0.03, exposure=0.03)
    shooting = _shooting(raycaster, flaws)
    shot = shooting.shoot(4)
    global_shutter = _shooting(raycaster, Flaws(exposure=0.03))
    path = room_motion("turning-60", raycaster.scene).path
    late = Shooting(raycaster, LENS, lambda t: path(t + 0.015), Flaws(exposure=0.03)).shoot(4)
    np.testing.assert_array_equal(shot.image[71], late.image[71])
    middle = np.abs(shot.image[35].astype(int) - global_shutter.shoot(4).image[35])
    assert middle.mean() < 1.0
    assert np.abs(shot.image[71].astype(int) - global_shutter.shoot(4).image[71]).mean() > 2


def test_truth_is_of_the_middle_row_at_mid_exposure(raycaster: Raycaster) -> None:
    flaws = Flaws(readout=0.03, exposure=0.02, noise=3.0, gain_drift=1.0, vignetting=0.4)
    shot = _shooting(raycaster, flaws).shoot(3)
    path = room_motion("turning-60", raycaster.scene).path
    np.testing.assert_array_equal(shot.T_wc, path(np.array([0.1]))[0])
    np.testing.assert_array_equal(shot.truth.depth, raycaster.render(LENS, shot.T_wc).depth)
    assert not shot.moving.any()


def test_without_flaws_the_image_is_the_plain_rendering(raycaster: Raycaster) -> None:
    shot = _shooting(raycaster, Flaws()).shoot(7)
    np.testing.assert_array_equal(shot.image, raycaster.render(CAMERA, shot.T_wc).image)


def test_light_that_nothing_is_done_to_stays(raycaster: Raycaster) -> None:
    """The sensor alone changes no image by more than rounding."""
    view = _shooting(raycaster, Flaws()).shoot(0).truth
    image = ImageSensor(Flaws(), CAMERA).develop((view.shade / 255) ** 2, 0, 0.0)
    assert np.abs(image.astype(int) - view.image).max() <= 1


def test_sensor() -> None:
    """Shading, gains and noise of a grey card."""
    card = np.full((72, 96, 3), 0.25, np.float32)
    shaded = ImageSensor(Flaws(vignetting=0.5), CAMERA).develop(card, 0, 0.0)
    assert shaded[0, 0, 0] == round(255 * np.sqrt(0.125))
    assert shaded[36, 48, 0] in (127, 128)
    drifting = ImageSensor(Flaws(gain_drift=0.5, colour_drift=0.1), CAMERA, seed=3)
    gains = np.array([drifting.gains(t) for t in np.arange(0, 30, 0.1)])
    assert np.abs(np.log2(gains[:, 1])).max() <= 0.5
    assert np.abs(np.log2(gains[:, 1])).max() > 0.25
    assert np.abs(np.diff(np.log2(gains[:, 1]))).max() < 0.15
    balance = gains[:, 0] / gains[:, 1] - 1
    np.testing.assert_allclose(gains[:, 2] / gains[:, 1], 1 - balance)
    assert 0.05 < np.abs(balance).max() <= 0.1
    image = drifting.develop(card, 5, 2.0)
    np.testing.assert_allclose(image[0, 0], 127.5 * np.sqrt(drifting.gains(2.0)), atol=0.51)
    noisy = ImageSensor(Flaws(noise=4.0), CAMERA)
    first, again, other = (noisy.develop(card, k, 0.0).astype(float) for k in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert first.std() == pytest.approx(4, rel=0.05)
    assert (first - other).std() == pytest.approx(4 * np.sqrt(2), rel=0.05)
    coarse = ImageSensor(Flaws(noise=4.0, jpeg=10), CAMERA).develop(card, 1, 0.0)
    assert 0.5 < np.abs(coarse - first).mean() < 8


def test_lens_is_opencv_s() -> None:
    """A pixel's ray, bent by the formula, is the pixel again; where nothing is bent, it is K^-1."""
    for k1, k2 in ((-0.25, 0.06), (0.1, -0.2), (0.3, 0.0)):
        x, y = RadialCamera(CAMERA, k1, k2).rays
        square = x * x + y * y
        bent = 1 + k1 * square + k2 * square * square
        u, v = CAMERA.fx * x * bent + CAMERA.cx, CAMERA.fy * y * bent + CAMERA.cy
        np.testing.assert_allclose(u, np.tile(np.arange(96.0), (72, 1)), atol=1e-9)
        np.testing.assert_allclose(v, np.tile(np.arange(72.0)[:, None], (1, 96)), atol=1e-9)
    np.testing.assert_array_equal(np.stack(LENS.rays, -1), CAMERA.rays(torch.float64)[..., :2])
    with pytest.raises(InputError, match="fold"):
        RadialCamera(CAMERA, -0.5, 0.0)


@pytest.mark.parametrize("kind", ["phone", "kinect", "action"])
def test_a_camera_held_upright_has_the_same_lens(kind: CameraKind) -> None:
    flaws = camera_flaws(kind)
    upright, across = centred_camera(72, 96), centred_camera(96, 72)
    assert upright.fx == upright.fy == across.fx
    turned, lens = (RadialCamera(c, flaws.k1, flaws.k2) for c in (upright, across))
    np.testing.assert_allclose(np.stack(turned.rays), np.stack(lens.rays)[::-1].transpose(0, 2, 1))


def test_distorted_views_miss_no_solid(raycaster: Raycaster) -> None:
    """Every pixel hits what a pinhole view with a ray through it hits."""
    path = room_motion("handheld", raycaster.scene).path
    T_wc = path(np.array([1.0]))[0]
    wide = centred_camera(800, 640, 0.35)
    straight = raycaster.render(wide, T_wc).depth
    for k1, k2 in ((-0.25, 0.06), (0.1, -0.2)):
        lens = RadialCamera(CAMERA, k1, k2)
        depth = raycaster.render(lens, T_wc).depth
        x, y = lens.rays
        u = np.rint(wide.fx * x + wide.cx).astype(int)
        v = np.rint(wide.fy * y + wide.cy).astype(int)
        assert (np.abs(straight[v, u] / depth - 1) < 0.02).mean() > 0.95


def test_walkers_cross_and_the_mask_is_theirs(scene: Scene, raycaster: Raycaster) -> None:
    """Where the mask is, the depth is nearer than the empty room's; elsewhere it is the same."""
    path = room_motion("slow-handheld", scene).path
    busy = raycaster.with_bodies(crossing_walkers(path, 3.0, CAMERA, 0.3))
    shooting = Shooting(busy, LENS, path, Flaws())
    fractions = []
    for index in range(0, 90, 10):
        shot = shooting.shoot(index)
        empty = raycaster.render(LENS, shot.T_wc)
        assert (shot.truth.depth[shot.moving] < empty.depth[shot.moving]).all()
        np.testing.assert_array_equal(shot.truth.depth[~shot.moving], empty.depth[~shot.moving])
        np.testing.assert_array_equal(shot.moving, shot.truth.solid >= len(scene))
        fractions.append(shot.moving.mean())
    assert 0.22 < max(fractions) < 0.36
    assert min(fractions) < 0.1


def test_walkers_walk(scene: Scene) -> None:
    """Rigidly, at a walking pace, and never through the camera."""
    path = room_motion("handheld", scene).path
    seen = []
    for body in crossing_walkers(path, 4.0, CAMERA, 0.2):
        times = np.arange(0, 4, 0.02)
        T_wb = body.path(times)
        rotation = T_wb[:, :3, :3]
        np.testing.assert_allclose(
            rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (200, 1, 1)), atol=1e-12
        )
        assert np.abs(T_wb[:, :2, 3] - path(times)[:, :2, 3]).max(1).min() > 0.4
        shown = T_wb[:, 2, 3] > -1
        seen.append(shown)
        speed = np.linalg.norm(np.diff(T_wb[:, :2, 3], axis=0), axis=1) / 0.02
        if shown.any():
            assert 0.3 < np.median(speed[shown[1:] & shown[:-1]]) < 3.0
    # One group of two at a time.
    assert (np.sum(seen, 0) == 2).all()


def test_a_rolling_shutter_bends_what_moves(scene: Scene, raycaster: Raycaster) -> None:
    """Rows of a mover are at its places at their own times."""
    path = room_motion("still", scene).path
    busy = raycaster.with_bodies(crossing_walkers(path, 3.0, CAMERA, 0.2))
    times = 1.0 + (np.arange(72) / 71 - 0.5) * 0.1
    view = busy.render_rolling(LENS, path(times), times)
    for row in (5, 60):
        still = busy.render(LENS, path(times[:1])[0], times[row])
        np.testing.assert_array_equal(view.solid[row], still.solid[row])
        np.testing.assert_array_equal(view.image[row], still.image[row])
    assert (view.solid != busy.render(LENS, path(times[:1])[0], 1.0).solid).mean() > 0.003
