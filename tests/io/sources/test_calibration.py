"""Intrinsics: formats, conventions of the pixel centre, resolutions, turns, distortion."""

import json
import logging
import math

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.calibration_files import calibration_from_numbers, read_calibration
from geogs.io.sources.formats.tum import known_camera
from geogs.io.sources.known_intrinsics import (
    calibration_from_exif,
    guess_calibration,
    resolve_intrinsics,
)
from geogs.io.sources.undistort import Rectifier
from geogs.io.writers.intrinsics_file import write_intrinsics
from io_samples import gradient_image, write_image

BARREL = (-0.28, 0.07, 0.0002, 0.00002)
OPENCV_YAML = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320., 0., 501., 240., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0.1, -0.2, 0.001, 0.002, 0.05 ]
"""
EUROC_YAML = """sensor_type: camera
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375]
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


def numbers_of(calibration: Calibration) -> tuple[float, ...]:
    return (calibration.fx, calibration.fy, calibration.cx, calibration.cy)


@pytest.mark.parametrize(
    ("name", "content", "expected", "distortion", "size"),
    [
        ("c.txt", "500 501 320 240", (500, 501, 320, 240), (), None),
        ("c.txt", "500,501,320,240\n1e-1,-2e-1,1e-3,2e-3,5e-2", (500, 501, 320, 240),
         (0.1, -0.2, 0.001, 0.002, 0.05), None),
        ("c.txt", "500,501,320,240,0.1,0.2,0,0,0.3,0.4,0.5,0.6", (500, 501, 320, 240),
         (0.1, 0.2, 0, 0, 0.3, 0.4, 0.5, 0.6), None),
        ("K.txt", "500 0 320\n0 501 240\n0 0 1\n", (500, 501, 320, 240), (), None),
        ("K.txt", "500 0 320 0\n0 501 240 0\n0 0 1 0\n0 0 0 1\n", (500, 501, 320, 240), (), None),
        ("c.json", json.dumps({"camera": {"w": 1200, "h": 680, "fx": 600, "fy": 600, "cx": 599.5,
         "cy": 339.5, "scale": 6553.5}}), (600, 600, 599.5, 339.5), (), (1200, 680)),
        ("c.json", json.dumps({"fl_x": 500, "fl_y": 501, "cx": 320.5, "cy": 240.5, "w": 640,
         "h": 480, "k1": 0.1, "camera_model": "OPENCV"}), (500, 501, 320, 240),
         (0.1, 0, 0, 0, 0), (640, 480)),
        ("c.txt", "# COLMAP\n1 SIMPLE_RADIAL 640 480 500 320.5 240.5 0.1\n", (500, 500, 320, 240),
         (0.1, 0, 0, 0), (640, 480)),
        ("c.txt", "1 OPENCV 640 480 500 501 320.5 240.5 0.1 -0.2 0.001 0.002\n",
         (500, 501, 320, 240), (0.1, -0.2, 0.001, 0.002), (640, 480)),
        ("c.yaml", OPENCV_YAML, (500, 501, 320, 240), (0.1, -0.2, 0.001, 0.002, 0.05), (640, 480)),
        ("sensor.yaml", EUROC_YAML, (458.654, 457.296, 367.215, 248.375),
         (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05), (752, 480)),
    ],
)  # fmt: skip
def test_calibration_file_formats(tmp_path, name, content, expected, distortion, size):
    (tmp_path / name).write_text(content)
    calibration = read_calibration(tmp_path / name)
    assert numbers_of(calibration) == pytest.approx(expected)
    assert calibration.distortion == pytest.approx(distortion)
    assert (calibration.width, calibration.height) == (size or (None, None))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("c.txt", "500 500 320", "hold 3 numbers"),
        ("c.txt", "fx 500", "no calibration that can be understood"),
        ("c.txt", "0 500 320 240", "must be positive"),
        ("c.txt", "nan 500 320 240", "NaN"),
        ("c.txt", "500 500 320 240 0 0 inf 0", "NaN or infinity"),
        ("c.txt", "1 FOV 640 480 500 500 320 240 0.9", "not supported"),
        ("c.txt", "fisheye 500 500 320 240 0.1", "hold 5 numbers; expected fisheye,fx"),
        ("c.json", '{"fx": 1, "fy": 1, "cx": 0, "cy": 0, "lens": "omni"}', "not supported"),
        ("c.txt", "1 PINHOLE 6 4 5 5 3 2\n2 PINHOLE 8 4 5 5 3 2\n", "2 different cameras"),
        ("c.json", "{", "damaged or no JSON"),
        ("c.json", '{"camera": {"fx": 3}}', "no entry 'fy'"),
        ("c.yaml", "a: 1", "no entry 'camera_matrix'"),
    ],
)
def test_unusable_calibration_files(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message):
        read_calibration(tmp_path / name)


def test_option_may_be_numbers_a_file_or_auto(tmp_path, caplog):
    assert numbers_of(resolve_intrinsics("500,501,320,240", None, 640, 480)) == (500, 501, 320, 240)
    (tmp_path / "c.txt").write_text("400 400 319.5 239.5")
    assert resolve_intrinsics(str(tmp_path / "c.txt"), None, 640, 480).fx == 400
    known = calibration_from_numbers([450.0, 450.0, 320.0, 240.0], "the data set")
    assert resolve_intrinsics("auto", known, 640, 480).fx == 450
    with caplog.at_level(logging.INFO, logger="geogs"):
        guess = resolve_intrinsics("auto", None, 640, 480)
    assert guess.is_guess
    assert "intrinsics are unknown" in caplog.text
    assert 2 * math.degrees(math.atan(320 / guess.fx)) == pytest.approx(60)
    with pytest.raises(InputError, match="neither auto, nor a file"):
        resolve_intrinsics("calibration.txt", None, 640, 480)


def test_calibration_of_another_resolution_is_scaled_about_pixel_edges():
    full = Calibration(600.0, 600.0, 599.5, 339.5, width=1200, height=680)
    half = full.fit(600, 340)
    assert numbers_of(half) == (300, 300, 299.5, 169.5)
    with pytest.raises(InputError, match="are for 1200x680 images"):
        full.fit(640, 480)
    with pytest.raises(InputError, match="outside"):
        calibration_from_numbers([1000.0, 1000.0, 960.0, 540.0], "given").fit(640, 480)


@pytest.mark.parametrize("quarter_turns", [1, 3])
@pytest.mark.parametrize("size", [(640, 480), (None, None)])
def test_turned_calibration_projects_to_the_turned_pixel(quarter_turns, size):
    """A point seen at a stored pixel is seen at that pixel's place in the turned image."""
    distortion = (0.1, -0.05, 0.01, -0.02, 0.003)
    stored = Calibration(500.0, 510.0, 300.0, 250.0, distortion, *size)
    turned = stored.fit(480, 640, quarter_turns)
    ray = np.array([0.3, -0.2])
    x, y = distorted_pixel(stored.fit(640, 480), ray)
    width, height = 640, 480
    for _ in range(quarter_turns):
        x, y, width, height = height - 1 - y, x, height, width
        ray = np.array([-ray[1], ray[0]])
    np.testing.assert_allclose(distorted_pixel(turned, ray), [x, y], atol=1e-9)


def test_calibration_of_the_shown_images_is_not_turned():
    shown = Calibration(500.0, 510.0, 240.0, 320.0, width=480, height=640)
    assert shown.fit(480, 640, quarter_turns=1) == shown
    assert numbers_of(Calibration(500.0, 510.0, 240.0, 320.0).fit(480, 640, 1))[2:] == (240, 320)


def distorted_pixel(calibration: Calibration, ray: np.ndarray) -> np.ndarray:
    """Where OpenCV's model sees the direction x/z, y/z."""
    point = np.array([[*ray, 1.0]])
    K = calibration.camera().matrix().numpy()
    distortion = np.array(calibration.distortion)
    return cv2.projectPoints(point, np.zeros(3), np.zeros(3), K, distortion)[0].ravel()


def test_exif_focal_length_is_by_diagonal(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 26
    Image.new("RGB", (4000, 3000)).save(tmp_path / "photo.jpg", exif=exif)
    calibration = calibration_from_exif(tmp_path / "photo.jpg")
    assert calibration.fx == pytest.approx(26 * 5000 / math.hypot(36, 24))
    assert calibration.is_nominal
    assert not calibration.is_guess
    Image.new("RGB", (40, 30)).save(tmp_path / "plain.jpg")
    assert calibration_from_exif(tmp_path / "plain.jpg") is None
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe1nonsense")
    assert calibration_from_exif(tmp_path / "broken.jpg") is None


def test_working_camera_is_exact_and_never_enlarged():
    calibration = guess_calibration(640, 480)
    assert Rectifier(calibration, 1000).camera == calibration.camera()
    assert Rectifier(calibration, 0).camera == calibration.camera()
    small = Rectifier(calibration, 320)
    assert (small.camera.width, small.camera.height) == (320, 240)
    assert small.camera.cx == pytest.approx((calibration.cx + 0.5) / 2 - 0.5)


def test_resized_image_agrees_with_the_resized_camera():
    """A blob drawn where a point projects is found where the working camera projects it."""
    calibration = Calibration(500.0, 500.0, 330.2, 236.1, width=640, height=480)
    rectifier = Rectifier(calibration, 200)
    point = torch.tensor([0.21, -0.17, 1.0], dtype=torch.float64)
    image = blob(calibration.camera().project(point)[0].numpy(), 640, 480)
    expected = rectifier.camera.project(point)[0].numpy()
    np.testing.assert_allclose(centroid(rectifier(image)), expected, atol=0.02)


@pytest.mark.parametrize("distortion", [BARREL, known_camera("fr1").distortion, (0.1, 0, 0, 0)])
@pytest.mark.parametrize("long_edge", [0, 320])
def test_undistorted_image_agrees_with_the_pinhole(distortion, long_edge):
    calibration = Calibration(
        517.3, 516.5, 318.6, 255.3, tuple(map(float, distortion)), width=640, height=480
    )
    rectifier = Rectifier(calibration, long_edge)
    for ray in ([0.3, 0.2], [-0.35, 0.1], [0.1, -0.3]):
        drawn = distorted_pixel(calibration, np.array(ray))
        found = centroid(rectifier(blob(drawn, 640, 480)))
        point = torch.tensor([*ray, 1.0], dtype=torch.float64)
        expected = rectifier.camera.project(point)[0].numpy()
        np.testing.assert_allclose(found, expected, atol=0.05)


@pytest.mark.parametrize("distortion", [BARREL, known_camera("fr1").distortion, (0.1, 0.0, 0, 0)])
def test_undistorted_image_has_no_black_border(distortion):
    calibration = Calibration(
        460.0, 460.0, 322.0, 236.0, tuple(map(float, distortion)), width=640, height=480
    )
    rectifier = Rectifier(calibration, 0)
    assert 1 <= rectifier.zoom < 1.5
    u, v = rectifier._maps
    slack = 0.51
    assert -slack <= u.min() <= u.max() <= 639 + slack
    assert -slack <= v.min() <= v.max() <= 479 + slack
    if rectifier.zoom > 1.001:  # no larger than needed
        edge = min(u.min(), v.min(), 639 - u.max(), 479 - v.max())
        assert edge < 0


def test_distortion_that_folds_the_image_is_refused():
    calibration = Calibration(
        500.0, 500.0, 320.0, 240.0, (-900.0, 0.0, 0.0, 0.0), width=640, height=480
    )
    with pytest.raises(InputError, match="fold"):
        Rectifier(calibration, 0)


def test_intrinsics_json_round_trip(tmp_path):
    """The file stands for the source where it has one, else for the working camera."""
    source = Calibration(
        517.3, 516.5, 318.6, 255.3, (0.1, -0.2, 0.001, 0.002), 640, 480, origin="a test"
    )
    working = Camera(200.1, 200.2, 160.3, 120.4, 320, 240)
    write_intrinsics(tmp_path / "a.json", working, source)
    read = read_calibration(tmp_path / "a.json")
    assert numbers_of(read) == numbers_of(source)
    assert read.distortion == source.distortion
    write_intrinsics(tmp_path / "b.json", working)
    assert read_calibration(tmp_path / "b.json").camera() == working
    assert json.loads((tmp_path / "a.json").read_text())["fx"] == 200.1


def blob(centre: np.ndarray, width: int, height: int) -> np.ndarray:
    """A white Gaussian of 3 pixels on black, small enough that distortion does not skew it."""
    v, u = np.mgrid[:height, :width]
    value = 255 * np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / (2 * 3.0**2))
    return np.repeat(value.round().astype(np.uint8)[..., None], 3, axis=2)


def centroid(image: np.ndarray) -> np.ndarray:
    """Centre of the light in pixels (x, y)."""
    weight = image[..., 0].astype(float)
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


def test_exif_is_used_for_a_folder_of_photographs(tmp_path):
    from geogs.io.sources.sniff import open_source

    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28
    Image.fromarray(gradient_image(0)).save(tmp_path / "a.jpg", exif=exif)
    write_image(tmp_path / "b.jpg", gradient_image(1))
    source = open_source(tmp_path)
    assert source.camera.fx == pytest.approx(28 * 80 / math.hypot(36, 24))
    assert source.intrinsics_origin == "EXIF of a.jpg (28 mm equivalent)"
