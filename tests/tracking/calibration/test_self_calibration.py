"""The focal length of a video from its images alone, and what is said where it cannot be."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

import tracking_scenes
from geogs.bundle.lens import LensBlock
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.camera.shutter.shutter import FoundReadout
from geogs.geometry.camera import Camera
from geogs.tracking.calibration import self_calibration
from geogs.tracking.calibration.degeneracy import Degeneracy
from geogs.tracking.calibration.growing_bundle import GrowingBundle
from geogs.tracking.calibration.self_calibration import LEAST_DEVIATION, _row_times, self_calibrate
from geogs.tracking.calibration.unknowns import Unknowns
from geogs.types import Frame
from lenses import with_lens
from tracking_scenes import CAMERA, frames, pose, render

pytestmark = pytest.mark.system


@pytest.fixture(autouse=True)
def _few_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(self_calibration, "START_KEYFRAMES", 8)
    monkeypatch.setattr(self_calibration, "KEYFRAMES", 16)


def swinging(count: int) -> list[np.ndarray]:
    """A path sideways and forwards that turns one way and back."""
    return [
        pose(-0.5 + 0.04 * k, 0.1 * np.sin(0.5 * k), 0.3 * np.sin(0.2 * k), 0.35 * np.sin(0.3 * k))
        for k in range(count)
    ]


@pytest.mark.parametrize("factor", [0.65, pytest.param(1.5, marks=pytest.mark.long)])
def test_finds_the_focal_length_of_a_rendered_room(factor):
    guess = CAMERA.with_focal(factor * CAMERA.fx)
    shares = []
    found = self_calibrate(frames(swinging(22)), guess, report=shares.append)
    assert found.failure is None
    error = abs(found.camera.fx / CAMERA.fx - 1)
    print(f"{found.camera.fx:.2f} +- {100 * found.deviation:.2f} %, error {100 * error:.2f} %")
    assert error < 0.01
    assert error < 2.5 * found.deviation
    assert LEAST_DEVIATION <= found.deviation < 0.05
    assert found.camera.fx == pytest.approx(found.camera.fy)
    assert found.squeeze == 1
    assert (found.camera.cx, found.camera.cy) == (CAMERA.cx, CAMERA.cy)
    assert found.distortion is found.deviations is None
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def tilted(T_wc: np.ndarray, angle: float) -> np.ndarray:
    """A pose that looks up by an angle in radians: a level camera does not tell the aspect."""
    turn = np.eye(4)
    turn[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return T_wc @ turn


@pytest.mark.parametrize("wide", [0.75, pytest.param(1.1, marks=pytest.mark.long)])
def test_pixels_that_are_no_squares_are_found(wide):
    width = round(wide * CAMERA.width)
    path = [tilted(T, 0.25 * np.sin(0.5 * k)) for k, T in enumerate(swinging(22))]
    squeezed = [
        replace(frame, image=cv2.resize(frame.image, (width, CAMERA.height)))
        for frame in frames(path)
    ]
    truth = CAMERA.resized(width, CAMERA.height)
    guess = replace(truth, fx=1.1 * truth.fx, fy=1.1 * truth.fx)
    found = self_calibrate(squeezed, guess)
    assert found.failure is None
    assert found.camera.fx == pytest.approx(truth.fx, rel=0.015)
    assert found.squeeze == pytest.approx(truth.fy / truth.fx, rel=0.01)


def test_rows_of_a_known_and_of_an_unknown_readout_are_seen_with_the_lens(monkeypatch):
    """Of a room rendered row by row; taken for those of a global shutter the lens is off."""
    readout, bundles, adjust = 0.025, [], GrowingBundle.adjust

    def noted(bundle: GrowingBundle) -> bool:
        bundles.append(bundle)
        return adjust(bundle)

    monkeypatch.setattr(GrowingBundle, "adjust", noted)
    monkeypatch.setattr(self_calibration, "MAX_COST", np.inf)
    video = list(rolled(30, readout))
    guess, rolling = CAMERA.with_focal(0.8 * CAMERA.fx), RollingCamera(CAMERA)
    off, residuals = [], []
    for given in ({}, {"rolling": rolling, "readout": readout}, {"rolling": rolling}):
        self_calibrate(iter(video), guess, Unknowns(**given))
        off.append(abs(bundles[-1].lens.fx / CAMERA.fx - 1))
        residuals.append(bundles[-1].residual)
    print(off, residuals, bundles[-1].readout)
    assert bundles[-1].readout == pytest.approx(readout, rel=0.45)  # of a few views of planes
    assert max(off[1:]) < 0.7 * off[0]
    assert max(residuals[1:]) < 0.8 * residuals[0]


def test_images_that_are_far_apart_in_time_say_nothing_of_rows():
    slow = [replace(f, timestamp=float(f.index)) for f in frames(swinging(22))]
    guess = CAMERA.with_focal(0.8 * CAMERA.fx)
    found = self_calibrate(slow, guess, Unknowns(rolling=RollingCamera(CAMERA)))
    assert found.failure is None
    assert found.camera == self_calibrate(slow, guess).camera
    assert found.readout == FoundReadout()


def test_the_readout_is_found_where_the_lens_is_given():
    """Of a room rendered row by row; the lens stays as it is given."""
    for readout in (0.025, 0.0):
        unknowns = Unknowns(focal=False, rolling=RollingCamera(CAMERA))
        found = self_calibrate(rolled(30, readout), CAMERA, unknowns)
        print(found.readout)
        assert (found.camera, found.distortion, found.failure) == (CAMERA, None, None)
        assert found.deviation == 0
        assert abs(found.readout.best - readout) < max(2.5 * found.readout.error, 0.002)
        assert found.readout.error < 0.004
        assert found.readout.is_believed == (readout > 0)


def test_times_of_rows_are_those_of_the_image_as_it_came():
    """A quarter turn reads columns; of a barrel lens the times are nearest to the true ones."""
    turned = _row_times(RollingCamera(CAMERA, quarter_turns=1), CAMERA)
    first, last = turned.of(torch.tensor([[0.0, 0.0], [CAMERA.width - 1.0, 0.0]])).tolist()
    assert (first, last) == (pytest.approx(0.5), pytest.approx(-0.5))
    assert turned.per_row == pytest.approx(0.0, abs=1e-9)
    barrel = RollingCamera(with_lens(CAMERA, (-0.2, 0.05, 0.0, 0.0)))
    small = CAMERA.with_long_edge(CAMERA.long_edge // 2)
    times = _row_times(barrel, small)
    pixels = torch.rand(200, 2) * torch.tensor([small.width - 1.0, small.height - 1.0])
    rays = np.c_[small.plane(pixels.double()).numpy(), np.ones(200)]
    true = torch.from_numpy(barrel.line_times(barrel.pixels(rays)))
    assert float((times.of(pixels) - true).abs().max()) < 0.04
    assert float((times.of(pixels) - true).square().mean().sqrt()) < 0.012


def rolled(count: int, readout: float) -> Iterator[Frame]:
    """A hand's path, each row rendered where the camera is then, in bands of a few."""

    def at(k: float) -> np.ndarray:
        x, y, z = -0.5 + 0.03 * k, 0.06 * np.sin(0.4 * k), 0.08 * np.sin(0.3 * k)
        return pose(x, y, z, 0.2 * np.sin(0.15 * k) + 0.03 * np.sin(0.5 * k))

    band, height = 6, CAMERA.height
    for k in range(count):
        image = np.zeros((height, CAMERA.width, 3), np.uint8)
        for top in range(0, height, band):
            middle = (top + (band - 1) / 2 + 0.5) / height - 0.5
            rows = replace(CAMERA, cy=CAMERA.cy - top, height=band)
            image[top : top + band] = render(at(k + 30 * readout * middle), rows)[0]
        yield Frame(k, k / 30, image)


@pytest.mark.long
def test_the_distortion_of_a_pinhole_is_about_none():
    found = self_calibrate(frames(swinging(22)), CAMERA.with_focal(200.0), Unknowns(radial=True))
    assert found.failure is None
    assert found.distortion is not None
    assert found.deviations is not None
    print(found)
    for number, deviation in zip(found.distortion, found.deviations, strict=True):
        assert abs(number) < min(0.05, 2.5 * deviation)
    assert abs(found.camera.fx / CAMERA.fx - 1) < min(0.03, 2.5 * found.deviation)


@pytest.mark.long
def test_finds_the_distortion_of_a_barrel_lens():
    wide = Camera(CAMERA.fx, CAMERA.fy, 143.5, 107.5, 288, 216)
    barrel = CAMERA.moved(0.0, -0.2, 0.05)
    rays = LensBlock(barrel, torch.from_numpy(pixels_of(CAMERA))).rays.numpy()
    at = (rays @ wide.matrix().numpy().T.astype(np.float32))[:, :2]
    at = at.reshape(CAMERA.height, CAMERA.width, 2)
    video = [
        Frame(k, k / 30, cv2.remap(render(T, wide)[0], at, None, cv2.INTER_CUBIC))
        for k, T in enumerate(swinging(22))
    ]
    found = self_calibrate(video, CAMERA.with_focal(190.0), Unknowns(radial=True))
    assert found.failure is None
    assert found.distortion is not None
    assert found.deviations is not None
    print(found)
    for number, true, deviation in zip(
        found.distortion, (-0.2, 0.05), found.deviations, strict=True
    ):
        assert abs(number - true) < min(0.03, 2.5 * deviation)
    assert abs(found.camera.fx / CAMERA.fx - 1) < min(0.02, 2.5 * found.deviation)


def pixels_of(camera: Camera) -> np.ndarray:
    """x, y of every pixel, row by row."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    return np.stack([u, v], -1).reshape(-1, 2)


def test_a_camera_that_only_turns_tells_its_focal_length():
    path = [pose(0.0, 0.0, 0.0, 0.03 * k) for k in range(16)]
    found = self_calibrate(frames(path), CAMERA.with_focal(120.0))
    assert found.failure is None
    error = abs(found.camera.fx / CAMERA.fx - 1)
    print(f"{found.camera.fx:.2f} +- {100 * found.deviation:.2f} %, error {100 * error:.2f} %")
    assert error < min(0.01, 2.5 * found.deviation)


def test_a_camera_that_never_turns_does_not_tell_it():
    path = [pose(-0.5 + 0.04 * k, 0.1 * np.sin(0.5 * k), 0.0, 0.0) for k in range(16)]
    guess = CAMERA.with_focal(120.0)
    found = self_calibrate(frames(path), guess, Unknowns(radial=True))
    assert found.failure is not None
    assert "leaves the focal length unsure" in found.failure
    assert found.camera == guess


def test_a_plane_is_said_to_be_one(monkeypatch):
    plane, hidden = ((0.2, 0.1, 1.0), 2.5), ((0.0, 0.0, 1.0), 100.0)
    monkeypatch.setattr(tracking_scenes, "PLANES", [plane, hidden])
    guess = CAMERA.with_focal(120.0)
    found = self_calibrate(frames(swinging(16)), guess)
    assert found.failure == "it shows a single plane"
    assert found.camera == guess


def test_that_nothing_explains_a_stretch_is_what_is_said(monkeypatch):
    said = iter(["its motion could not be followed", Degeneracy.UNEXPLAINED.value])
    monkeypatch.setattr(self_calibration, "STRETCHES", 2)
    monkeypatch.setattr(self_calibration, "START_KEYFRAMES", 2)
    monkeypatch.setattr(self_calibration.Stretch, "ask", lambda self: next(said))
    found = self_calibrate(frames(swinging(4)), CAMERA.with_focal(120.0))
    assert found.failure == Degeneracy.UNEXPLAINED.value


def test_a_camera_that_stands_still_is_said_to():
    guess = CAMERA.with_focal(120.0)
    found = self_calibrate(frames([pose(0.0)] * 5), guess)
    assert found.failure == "the camera hardly moves"
    assert found.camera == guess
    assert found.frames == 5


def test_frames_without_texture_are_said_to_have_none():
    grey = [replace(f, image=np.full_like(f.image, 90)) for f in frames([pose(0.0)] * 3)]
    assert self_calibrate(grey, CAMERA).failure == "no frame has enough texture"


def test_what_the_report_raises_passes_through():
    def stop(fraction: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        self_calibrate(frames(swinging(4)), CAMERA, report=stop)
