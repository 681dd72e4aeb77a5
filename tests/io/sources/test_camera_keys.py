"""Keys of cameras in JSON and YAML: lens, focal length, and what is refused or told."""

import json
import math

import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.calibration_files import read_calibration
from geogs.io.sources.sniff import open_posed_source, open_source
from io_samples import gradient_image, write_image

NATIVE = InputConfig(long_edge=0)
W, H = 64, 48
FX, FY = 40.0, 40.0
WIDE = 2 * math.atan(W / 2 / FX)
HIGH = 2 * math.atan(H / 2 / FY)
FISHEYE = {"k1": 0.05, "k2": -0.02, "k3": 0.01, "k4": -0.002}


def write_transforms(folder, document=None, frame=None, count=3):
    """A transforms.json with images one step apart; ``frame`` holds keys of each image."""
    frames = []
    for i in range(count):
        write_image(folder / "images" / f"{i}.png", gradient_image(i, W, H))
        T = np.eye(4)
        T[0, 3] = i
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": T.tolist()})
        frames[-1] |= frame or {}
    (folder / "transforms.json").write_text(json.dumps((document or {}) | {"frames": frames}))
    return folder


def calibration(folder):
    return open_posed_source(folder, NATIVE)._files[0].calibration


FOCAL = {
    "pixels": {"fl_x": FX, "fl_y": FY},
    "x alone": {"fl_x": FX},
    "y alone": {"fl_y": FY},
    "degrees": {"x_fov": math.degrees(WIDE)},
    "degrees of y": {"y_fov": math.degrees(HIGH)},
    "radians": {"camera_angle_x": WIDE},
    "radians of y": {"camera_angle_y": HIGH},
    "both": {"camera_angle_x": WIDE, "camera_angle_y": HIGH},
    "all": {"fl_x": FX, "fl_y": FY, "camera_angle_x": WIDE, "x_fov": math.degrees(WIDE)},
    "text": {"x_fov": str(math.degrees(WIDE))},
}


@pytest.mark.parametrize("size", [{}, {"w": W, "h": H}, {"w": 2 * W, "h": 2 * H}])
@pytest.mark.parametrize("level", ["document", "frame"])
@pytest.mark.parametrize("keys", FOCAL.values(), ids=FOCAL)
def test_the_focal_length_is_read_by_every_key(keys, level, size, tmp_path):
    scale = size.get("w", W) / W
    keys = {k: v * scale if k.startswith("fl") else v for k, v in keys.items()} | size
    write_transforms(tmp_path, **{level: keys})
    for source in (open_posed_source(tmp_path, NATIVE), open_source(tmp_path, NATIVE)):
        camera = source.camera
        assert (camera.fx, camera.fy) == pytest.approx((FX, FY))
        assert (camera.cx, camera.cy) == pytest.approx(((W - 1) / 2, (H - 1) / 2))
        assert not source.account.left


def test_a_size_that_is_null_is_that_of_the_images(tmp_path):
    write_transforms(tmp_path, {"camera_angle_x": WIDE, "w": None, "h": None, "cx": None})
    assert calibration(tmp_path).fx == pytest.approx(FX)
    assert read_calibration(tmp_path / "transforms.json").width == W


def test_fx_and_fy_may_differ(tmp_path):
    write_transforms(tmp_path, {"x_fov": math.degrees(WIDE), "camera_angle_y": HIGH * 0.9})
    source = open_posed_source(tmp_path, NATIVE)
    assert source.camera.fx == pytest.approx(FX)
    assert source.camera.fy == pytest.approx(H / 2 / math.tan(HIGH * 0.45))
    assert "x_fov" in source.account.used[0]


def test_a_focal_length_of_a_frame_replaces_that_of_all(tmp_path):
    write_transforms(tmp_path, {"fl_x": 99.0, "fl_y": 99.0}, {"camera_angle_x": WIDE})
    assert calibration(tmp_path).fx == pytest.approx(FX)


def test_focal_lengths_that_contradict_each_other_are_told(tmp_path):
    write_transforms(tmp_path, {"fl_x": FX, "camera_angle_x": 1.5 * WIDE})
    (said,) = read_calibration(tmp_path / "transforms.json").account.left
    assert said.startswith("camera_angle_x of ")
    assert said.endswith("it says 20.0 pixels, not 40.0")


@pytest.mark.parametrize(
    "keys", [{"x_fov": 1.35}, {"camera_angle_x": 77.3}, {"x_fov": 180.0}, {"camera_angle_y": 0.01}]
)
def test_an_angle_in_the_wrong_unit_is_refused(keys, tmp_path):
    write_transforms(tmp_path, keys)
    with pytest.raises(InputError, match="is it in another unit"):
        open_posed_source(tmp_path, NATIVE)


@pytest.mark.parametrize("level", ["document", "frame"])
@pytest.mark.parametrize(
    "lens",
    [
        {"is_fisheye": True},
        {"is_fisheye": 1},
        {"is_fisheye": "true"},
        {"camera_model": "OPENCV_FISHEYE"},
        {"camera_model": "opencv-fisheye"},
        {"camera_model": "KannalaBrandt8"},
        {"camera_model": "FISHEYE", "is_fisheye": True},
        {"camera_type": "fisheye"},
    ],
    ids=str,
)
def test_a_fisheye_is_read_by_every_key(lens, level, tmp_path):
    keys = {"fl_x": FX, **FISHEYE, "p1": 0, "p2": 0, **lens}
    write_transforms(tmp_path, **{level: keys})
    found = calibration(tmp_path)
    assert (found.lens, found.distortion) == ("fisheye", tuple(FISHEYE.values()))
    assert not open_posed_source(tmp_path, NATIVE).account.left


@pytest.mark.parametrize(
    "lens",
    [
        {},
        {"is_fisheye": False},
        {"camera_model": "OPENCV", "is_fisheye": False},
        {"camera_model": "PINHOLE"},
        {"camera_model": "SIMPLE_RADIAL"},
        {"camera_type": "perspective"},
        {"latlong": False, "camera_model": None},
        {"camera_type": "iPhone 15", "model": "OmniVision OV9281, wide fov"},
        {"skew": 0.02},
    ],
    ids=str,
)
def test_a_polynomial_lens_stays_one(lens, tmp_path):
    write_transforms(tmp_path, {"fl_x": FX, "k1": 0.1, "p2": 0.01, "k4": 0.0, **lens})
    found = calibration(tmp_path)
    assert (found.lens, found.distortion) == ("polynomial", (0.1, 0, 0, 0.01, 0))


def test_a_lens_of_a_frame_replaces_that_of_all(tmp_path):
    write_transforms(
        tmp_path, {"fl_x": FX, "camera_model": "OPENCV", **FISHEYE}, {"is_fisheye": True}
    )
    assert calibration(tmp_path).lens == "fisheye"
    write_transforms(tmp_path, {"fl_x": FX, "is_fisheye": True, **FISHEYE}, {"type": "colour"})
    assert calibration(tmp_path).lens == "fisheye"


@pytest.mark.parametrize("level", ["document", "frame"])
@pytest.mark.parametrize(
    ("lens", "message"),
    [
        ({"latlong": True}, "latlong"),
        ({"equirectangular": True}, "equirectangular"),
        ({"ftheta_p0": 0.0, "ftheta_p1": 9e-4}, "ftheta_p1"),
        ({"orthographic": True}, "orthographic"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"camera_model": "FISHEYE624"}, "FISHEYE624"),
        ({"camera_model": "VR180_L"}, "VR180_L"),
        ({"camera_model": "THIN_PRISM_FISHEYE"}, "THIN_PRISM_FISHEYE"),
        ({"camera_model": "something new"}, "of that model"),
        ({"camera_type": "equirectangular"}, "equirectangular"),
        ({"camera_model": "OPENCV", "is_fisheye": True}, "contradict"),
        ({"camera_model": "OPENCV_FISHEYE", "is_fisheye": False}, "contradict"),
        ({"k4": 0.01}, "k4.*fisheye"),
        ({"is_fisheye": True, "p1": 0.01}, "p1"),
        ({"skew": 3.0}, "skew"),
        ({"from_na": True}, "other axes"),
    ],
    ids=str,
)
def test_what_changes_the_projection_is_refused_by_name(lens, message, level, tmp_path):
    write_transforms(tmp_path, **{level: {"fl_x": FX, **lens}})
    with pytest.raises(InputError, match=message):
        open_posed_source(tmp_path, NATIVE)
    if level == "document":
        with pytest.raises(InputError, match=message):
            read_calibration(tmp_path / "transforms.json")


def test_a_rational_lens(tmp_path):
    terms = {f"k{i}": 0.01 * i for i in range(1, 7)}
    write_transforms(tmp_path, {"fl_x": FX, "camera_model": "FULL_OPENCV", **terms})
    assert calibration(tmp_path).distortion == pytest.approx(
        (0.01, 0.02, 0, 0, 0.03, 0.04, 0.05, 0.06)
    )


def test_unknown_keys_are_told_and_harmless_ones_are_not(tmp_path):
    harmless = {"fl_x": FX, "aabb_scale": 16, "scale": 0.33, "offset": [0.5, 0.5, 0.5]}
    write_transforms(tmp_path, harmless, {"sharpness": 31.0, "colmap_im_id": 3})
    assert open_posed_source(tmp_path, NATIVE).account.left == ()
    unknown = {"rolling_shutter": [0, 0.0, 0.03, 0], "zebra": 1, "nothing": None}
    write_transforms(tmp_path, harmless | unknown, {"transform_matrix_end": [[1]]})
    (said,) = open_posed_source(tmp_path, NATIVE).account.left
    assert said.startswith("keys rolling_shutter, zebra, transform_matrix_end of ")
    assert "--readout" in said
    (same,) = open_source(tmp_path, NATIVE).account.left
    assert same == said


def test_keys_of_other_files_are_told(tmp_path):
    write_transforms(tmp_path, {"fl_x": FX}, {"intrinsics": [FX, FY, 32, 24]})
    (said,) = open_posed_source(tmp_path, NATIVE).account.left
    assert said.startswith("keys intrinsics of ")


def test_pictures_that_are_not_listed_are_told(tmp_path):
    write_transforms(tmp_path, {"fl_x": FX})
    write_image(tmp_path / "images" / "9.png", gradient_image(9, W, H))
    (said,) = open_posed_source(tmp_path, NATIVE).account.left
    assert said.startswith("pictures that are not listed: 1, such as")


def test_other_descriptions_of_a_folder_are_told(tmp_path):
    write_transforms(tmp_path, {"fl_x": FX})
    (tmp_path / "transforms_test.json").write_text("{}")
    for name in ("cameras.txt", "images.txt"):
        (tmp_path / name).write_text("")
    transforms, model = open_posed_source(tmp_path, NATIVE).account.left
    assert transforms == f"transforms_test.json beside {tmp_path / 'transforms.json'}"
    assert model == "the COLMAP model, as the other poses are there"


def test_images_beside_poses_without_a_focal_length_are_read(tmp_path):
    write_transforms(tmp_path)
    assert open_source(tmp_path, NATIVE).is_calibration_open
    assert open_posed_source(tmp_path, NATIVE).is_focal_guess
    with pytest.raises(InputError, match="states no focal length"):
        read_calibration(tmp_path / "transforms.json")


def test_cameras_that_vary_give_the_median_one(tmp_path):
    write_transforms(tmp_path, {"fl_x": 1.0})
    document = json.loads((tmp_path / "transforms.json").read_text())
    for frame, focal in zip(document["frames"], (39.0, 41.0, 40.0), strict=True):
        frame["fl_x"] = focal
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    found = read_calibration(tmp_path / "transforms.json")
    assert found.fx == 40
    assert found.account.used == ("the median of focal lengths that vary by 5.1%",)
    document["frames"][0]["is_fisheye"] = True
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="2 different cameras"):
        read_calibration(tmp_path / "transforms.json")


KALIBR = "intrinsics: [40, 41, 32, 24]\nresolution: [64, 48]\n"
ROS = "image_width: 64\nimage_height: 48\ncamera_matrix: {data: [40, 0, 32, 0, 41, 24, 0, 0, 1]}\n"
ROWS = [[40, 0, 32], [0, 41, 24], [0, 0, 1]]


@pytest.mark.parametrize(
    ("name", "text", "lens", "distortion"),
    [
        (
            "a.yaml",
            KALIBR + "camera_model: pinhole\ndistortion_model: equidistant\n"
            "distortion_coeffs: [0.1, 0.2, 0.3, 0.4]\n",
            "fisheye",
            (0.1, 0.2, 0.3, 0.4),
        ),
        (
            "a.yaml",
            KALIBR + "camera_model: pinhole\ndistortion_model: radtan\n"
            "distortion_coeffs: [0.1, 0.2, 0.3, 0.4]\n",
            "polynomial",
            (0.1, 0.2, 0.3, 0.4),
        ),
        ("a.yaml", KALIBR + "camera_model: pinhole\ndistortion_model: none\n", "polynomial", ()),
        (
            "a.yaml",
            ROS + "distortion_model: plumb_bob\n"
            "distortion_coefficients: {data: [0.1, 0, 0, 0, 0]}\n",
            "polynomial",
            (0.1, 0, 0, 0, 0),
        ),
        (
            "a.yaml",
            ROS + "fisheye_model: 1\ndistortion_coefficients: {data: [0.1, 0, 0, 0]}\n",
            "fisheye",
            (0.1, 0, 0, 0),
        ),
        (
            "a.yaml",
            ROS + "distortion_coefficients: {data: [0.1" + 11 * ", 0" + "]}\n",
            "polynomial",
            (0.1, 0, 0, 0, 0, 0, 0, 0),
        ),
        (
            "a.yaml",
            "K: [40, 0, 32, 0, 41, 24, 0, 0, 1]\nD: [0.1, 0, 0, 0]\nwidth: 64\nheight: 48\n",
            "polynomial",
            (0.1, 0, 0, 0),
        ),
        (
            "a.yml",
            '%YAML:1.0\nCamera.type: "KannalaBrandt8"\nCamera.fx: 40\nCamera.fy: 41\n'
            "Camera.cx: 32\nCamera.cy: 24\nCamera.k1: 0.1\nCamera.k4: 0.4\nCamera.width: 64\n"
            "Camera.height: 48\n",
            "fisheye",
            (0.1, 0, 0, 0.4),
        ),
        ("a.json", {"K": ROWS, "w": 64, "h": 48}, "polynomial", ()),
        (
            "a.json",
            {"camera_matrix": ROWS, "dist_coeffs": [[0.1, 0, 0, 0, 0]]},
            "polynomial",
            (0.1, 0, 0, 0, 0),
        ),
        (
            "a.json",
            {"fx": 40, "fy": 41, "cx": 32, "cy": 24, "k1": 0.1, "k2": 0.2},
            "polynomial",
            (0.1, 0.2, 0, 0, 0),
        ),
        (
            "a.json",
            {"fx": 40, "fy": 41, "cx": 32, "cy": 24, "camera_model": "OPENCV_FISHEYE", "k3": 0.1},
            "fisheye",
            (0, 0, 0.1, 0),
        ),
        (
            "a.json",
            {
                "fx": 40,
                "fy": 41,
                "ppx": 32,
                "ppy": 24,
                "model": "distortion.brown_conrady",
                "coeffs": [0, 0, 0, 0, 0],
            },
            "polynomial",
            (0, 0, 0, 0, 0),
        ),
        ("a.txt", "1 SIMPLE_RADIAL_FISHEYE 64 48 40 32.5 24.5 0.1\r\n", "fisheye", (0.1, 0, 0, 0)),
        ("A.JSON", {"fx": 40, "fy": 41, "cx": 32, "cy": 24, "camera": "phone"}, "polynomial", ()),
        ("a.txt", "# a\r\n  # b\r\n1 FISHEYE 64 48 40 41 32.5 24.5\r\n", "fisheye", ()),
    ],
)
def test_cameras_of_calibration_files(name, text, lens, distortion, tmp_path):
    (tmp_path / name).write_bytes((text if isinstance(text, str) else json.dumps(text)).encode())
    found = read_calibration(tmp_path / name)
    assert (found.fx, found.cx, found.cy) == pytest.approx((40, 32, 24))
    assert found.lens == lens
    assert found.distortion == pytest.approx(distortion)
    assert found.account.left == ()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yaml", "camera_model: omni\n" + KALIBR, "omni"),
        ("a.yaml", "camera_model: ds\n" + KALIBR, "ds camera"),
        ("a.yaml", "camera_model: pinhole\ndistortion_model: fov\n" + KALIBR, "fov"),
        ("a.yaml", ROS + "distortion_model: thin_prism\n", "thin_prism"),
        ("a.json", {"fx": 40, "fy": 41, "cx": 32, "cy": 24, "xi": 0.8}, "xi"),
        ("a.json", {"fx": 40, "fy": 41, "cx": 32, "cy": 24, "model": "ftheta"}, "ftheta"),
        ("a.json", {"K": [[40, 3, 32], [0, 41, 24], [0, 0, 1]]}, "skew 3"),
        ("a.txt", "40 3 32\n0 41 24\n0 0 1\n", "skew 3"),
        ("a.txt", "1 EUCM 64 48 40 41 32 24 0.5 1.1\n", "EUCM"),
        ("a.txt", "1 SIMPLE_DIVISION 64 48 40 32 24 0.5\n", "SIMPLE_DIVISION"),
        ("a.txt", "1 PINHOLE 64 48 40 32 24\n", "PINHOLE camera has 4 parameters, not 3"),
    ],
)
def test_unknown_cameras_of_calibration_files_are_refused(name, text, message, tmp_path):
    (tmp_path / name).write_text(text if isinstance(text, str) else json.dumps(text))
    with pytest.raises(InputError, match=message):
        read_calibration(tmp_path / name)


def test_unknown_keys_of_a_calibration_file_are_told(tmp_path):
    (tmp_path / "a.yaml").write_text(ROS + "binning_x: 2\nroi: {x_offset: 3}\n")
    (said,) = read_calibration(tmp_path / "a.yaml").account.left
    assert said == f"keys binning_x, roi of {tmp_path / 'a.yaml'}"
