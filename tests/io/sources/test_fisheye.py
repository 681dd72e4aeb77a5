"""Fisheye and wide lenses: their calibrations, and the pinhole that is made of their images."""

import json
import math

import cv2
import numpy as np
import pytest
import torch

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.calibration_files import read_calibration
from geogs.io.sources.known_intrinsics import resolve_intrinsics
from geogs.io.sources.sniff import open_source
from geogs.io.sources.undistort import Rectifier
from geogs.io.writers.intrinsics_file import write_intrinsics
from io_samples import write_image
from rolling_scenes import RATE, READOUT, global_image, hand_held, rolling_image

K = (-0.02, 0.004, -0.003, 0.0007)
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.02, 0.004, -0.003, 0.0007]
  distortion_model: equidistant
  intrinsics: [210.0, 211.0, 320.0, 240.0]
  resolution: [640, 480]
"""
LENS = Calibration(210.0, 211.0, 320.0, 240.0, K, 640, 480, lens="fisheye")


def seen_at(calibration: Calibration, ray: np.ndarray) -> np.ndarray:
    """Where OpenCV's fisheye sees the direction x/z, y/z."""
    matrix = calibration.camera().matrix().numpy()
    point = np.array([[[*ray, 1.0]]])
    D = np.array(calibration.distortion)
    return cv2.fisheye.projectPoints(point, np.zeros(3), np.zeros(3), matrix, D)[0].ravel()


def blob(centre: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[:480, :640]
    light = 255 * np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / (2 * 1.5**2))
    return np.repeat(light[..., None].astype(np.uint8), 3, axis=2)


def centroid(image: np.ndarray) -> np.ndarray:
    weight = image[..., 0].astype(float)
    v, u = np.mgrid[: weight.shape[0], : weight.shape[1]]
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("c.txt", "fisheye 210 211 320 240 -0.02 0.004 -0.003 0.0007"),
        ("cameras.txt", "1 OPENCV_FISHEYE 640 480 210 211 320.5 240.5 -0.02 0.004 -0.003 0.0007"),
        ("transforms.json", json.dumps({"camera_model": "OPENCV_FISHEYE", "fl_x": 210, "fl_y": 211,
         "cx": 320.5, "cy": 240.5, "k1": -0.02, "k2": 0.004, "k3": -0.003, "k4": 0.0007})),
        ("camchain.yaml", KALIBR),
    ],
)  # fmt: skip
def test_calibrations_of_a_fisheye(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    read = read_calibration(tmp_path / name)
    assert (read.fx, read.fy, read.cx, read.cy) == (210, 211, 320, 240)
    assert read.distortion == K
    assert read.lens == "fisheye"
    assert read.is_distorted


def test_fisheyes_of_colmap_with_fewer_terms_and_of_the_option(tmp_path):
    (tmp_path / "c.txt").write_text("1 SIMPLE_RADIAL_FISHEYE 640 480 210 320.5 240.5 0.01\n")
    assert read_calibration(tmp_path / "c.txt").distortion == (0.01, 0, 0, 0)
    given = resolve_intrinsics("fisheye,105,105.5,159.75,119.75,-0.02,0,0,0", None, 640, 480, 0)
    assert (given.lens, given.fx) == ("fisheye", 105)
    plain = resolve_intrinsics("fisheye,210,211,320,240", None, 640, 480)
    assert plain.is_distorted
    with pytest.raises(InputError, match="neither auto, nor a file"):
        resolve_intrinsics("omni,210,211,320,240", None, 640, 480)


def test_the_written_intrinsics_stand_for_the_fisheye(tmp_path):
    write_intrinsics(tmp_path / "a.json", Rectifier(LENS, 320).camera, LENS)
    read = read_calibration(tmp_path / "a.json")
    assert (read.lens, read.distortion, read.fx) == ("fisheye", K, 210)


@pytest.mark.parametrize("field_of_view", ["auto", 60.0, 100.0])
@pytest.mark.parametrize("long_edge", [0, 320])
def test_the_image_agrees_with_the_pinhole(field_of_view, long_edge):
    rectifier = Rectifier(LENS, long_edge, field_of_view)
    camera = rectifier.camera
    degrees = 90.0 if field_of_view == "auto" else field_of_view
    assert 2 * math.degrees(math.atan(camera.width / 2 / camera.fx)) == pytest.approx(degrees)
    assert camera.fy / camera.fx == pytest.approx(211 / 210)
    for ray in ([0.3, 0.2], [-0.45, 0.1], [0.1, -0.3]):
        found = centroid(rectifier(blob(seen_at(LENS, np.array(ray)))))
        expected = camera.project(torch.tensor([*ray, 1.0], dtype=torch.float64))[0].numpy()
        np.testing.assert_allclose(found, expected, atol=0.15)


def test_more_than_the_lens_saw_is_refused_with_what_it_saw():
    with pytest.raises(InputError, match=r"of 150 degrees .* give at most (\d+\.\d)\.") as refused:
        Rectifier(LENS, 0, 150.0)
    most = float(str(refused.value).split("at most ")[1].rstrip("."))
    u, v = Rectifier(LENS, 0, most)._maps
    slack = 0.51
    assert -slack <= u.min() <= u.max() <= 639 + slack
    assert -slack <= v.min() <= v.max() <= 479 + slack
    with pytest.raises(InputError, match="at most"):
        Rectifier(LENS, 0, most + 1)


def test_a_pinhole_may_be_cropped_to_a_field_of_view():
    pinhole = Calibration(300.0, 300.0, 319.5, 239.5, width=640, height=480)
    camera = Rectifier(pinhole, 0, 60.0).camera
    assert camera.fx == pytest.approx(320 / math.tan(math.radians(30)))
    assert Rectifier(pinhole, 0).camera == pinhole.camera()


def test_turning_an_image_keeps_the_coefficients_of_a_fisheye():
    turned = Calibration(210.0, 211.0, 300.0, 230.0, K, 640, 480, lens="fisheye").fit(480, 640, 1)
    assert turned.distortion == K
    assert (turned.cx, turned.cy, turned.fx) == (480 - 1 - 230, 300, 211)


def test_fisheye_and_rows_are_undone_at_once(tmp_path):
    for k in range(3):
        image = rolling_image(hand_held, k / RATE, distortion=K, lens="fisheye")
        write_image(tmp_path / f"{k}.png", image)
    intrinsics = "fisheye,150,150,95.5,71.5," + ",".join(map(str, K))
    both = open_source(
        tmp_path, InputConfig(intrinsics, working_field_of_view=60.0, readout=READOUT)
    ).straight()
    lens = open_source(
        tmp_path, InputConfig(intrinsics, working_field_of_view=60.0, readout=0.0)
    ).straight()
    true = global_image(hand_held, 1 / RATE, both.camera).astype(float)
    inner = np.s_[12:-12, 12:-12]
    errors = [np.abs(list(s)[1].image - true)[inner].mean() for s in (both, lens)]
    assert errors[0] < 0.4 * errors[1]
