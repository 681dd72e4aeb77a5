"""Photographs that EXIF turns, beside cameras and poses of the stored pixels."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from geogs.config import InputConfig
from geogs.io.pictures import decoded, header_of, stored_size_and_turns, upright_size
from geogs.io.sources.posed.stored_pictures import read_picture, stored_size
from geogs.io.sources.sniff import open_posed_source, open_source
from io_samples import gradient_image

NATIVE = InputConfig(long_edge=0)
W, H = 64, 48
CX, CY = 30.5, 25.5
TURNS = {1: 0, 6: 1, 3: 2, 8: 3}


def save(path, image, orientation):
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[0x0112] = orientation
    quality = {"quality": 95} if path.suffix == ".jpg" else {}
    Image.fromarray(image).save(path, exif=exif, **quality)
    return path


@pytest.mark.parametrize("suffix", [".jpg", ".tif", ".png", ".webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_picture_is_turned_once_or_not_at_all(suffix, orientation, tmp_path):
    image = gradient_image(3, W, H)
    path = save(tmp_path / f"a{suffix}", image, orientation)
    upright = np.array(ImageOps.exif_transpose(Image.open(path)).convert("RGB")).astype(float)
    shown = decoded(path, cv2.IMREAD_COLOR).rgb
    assert np.abs(shown - upright).mean() < 6
    assert upright_size(path) == shown.shape[1::-1]
    stored = read_picture(path).astype(float)
    assert np.abs(stored - image).mean() < 6
    assert header_of(path)[0] == stored_size(path) == (W, H)
    if orientation in TURNS:
        assert stored_size_and_turns(path) == ((W, H), TURNS[orientation])
        np.testing.assert_array_equal(shown, np.rot90(stored, -TURNS[orientation]))


def write_photographs(folder, orientation, camera, suffix=".jpg", count=4):
    """Images of a camera that moves to the right in its stored pixels."""
    frames = []
    for i in range(count):
        save(folder / "images" / f"{i}{suffix}", gradient_image(i, W, H), orientation)
        T = np.eye(4)
        T[0, 3] = i
        frames.append({"file_path": f"images/{i}{suffix}", "transform_matrix": T.tolist()})
    (folder / "transforms.json").write_text(json.dumps(camera | {"frames": frames}))
    return folder


STORED = {"fl_x": 40.0, "fl_y": 41.0, "cx": CX + 0.5, "cy": CY + 0.5, "w": W, "h": H}
SHOWN = {
    6: {"fl_x": 41.0, "fl_y": 40.0, "cx": H - CY - 0.5, "cy": CX + 0.5, "w": H, "h": W},
    8: {"fl_x": 41.0, "fl_y": 40.0, "cx": CY + 0.5, "cy": W - CX - 0.5, "w": H, "h": W},
}


@pytest.mark.parametrize("suffix", [".jpg", ".tif"])
@pytest.mark.parametrize("orientation", [6, 8])
@pytest.mark.parametrize("is_stored", [True, False], ids=["stored", "shown"])
def test_the_calibration_turns_along(is_stored, orientation, suffix, tmp_path):
    given = STORED if is_stored else SHOWN[orientation]
    write_photographs(tmp_path, orientation, given, suffix)
    beside = open_source(tmp_path, NATIVE)
    file = tmp_path / "transforms.json"
    named = open_source(tmp_path / "images", InputConfig(intrinsics=str(file), long_edge=0))
    expected = SHOWN[orientation]
    for camera in (beside.camera, named.camera):
        assert (camera.width, camera.height) == (H, W)
        assert (camera.fx, camera.fy) == (41.0, 40.0)
        assert (camera.cx + 0.5, camera.cy + 0.5) == (expected["cx"], expected["cy"])


@pytest.mark.parametrize("orientation", TURNS)
def test_poses_of_stored_pixels_turn_along(orientation, tmp_path):
    """A camera that moves to the right in its stored pixels moves down in pictures turned by 90
    degrees clockwise."""
    write_photographs(tmp_path, orientation, STORED)
    source = open_source(tmp_path, InputConfig(poses="prior", long_edge=0))
    T_cw = [frame.pose.T_cw.numpy() for frame in source]
    moved = (T_cw[0] @ np.linalg.inv(T_cw[2]))[:3, 3]
    down = {1: (2, 0, 0), 6: (0, 2, 0), 3: (-2, 0, 0), 8: (0, -2, 0)}
    np.testing.assert_allclose(moved, down[orientation], atol=1e-9)


def test_poses_of_shown_pixels_stay(tmp_path):
    write_photographs(tmp_path, 6, SHOWN[6])
    source = open_source(tmp_path, InputConfig(poses="prior", long_edge=0))
    T_cw = [frame.pose.T_cw.numpy() for frame in source]
    np.testing.assert_allclose((T_cw[0] @ np.linalg.inv(T_cw[2]))[:3, 3], (2, 0, 0), atol=1e-9)


@pytest.mark.parametrize("suffix", [".jpg", ".tif"])
@pytest.mark.parametrize("orientation", [6, 8])
@pytest.mark.parametrize("is_stored", [True, False], ids=["stored", "shown"])
def test_images_with_known_poses_are_the_stored_pixels(is_stored, orientation, suffix, tmp_path):
    """Cameras and poses of the shown pictures are turned back."""
    write_photographs(tmp_path, orientation, STORED if is_stored else SHOWN[orientation], suffix)
    source = open_posed_source(tmp_path, NATIVE)
    camera = source.camera
    assert (camera.width, camera.height) == (W, H)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40.0, 41.0, CX, CY)
    assert np.abs(source[1].image.astype(float) - gradient_image(1, W, H)).mean() < 6
    moved = (source.T_cw[0] @ np.linalg.inv(source.T_cw[2]))[:3, 3]
    right = (2, 0, 0) if is_stored else (0, -2, 0) if orientation == 6 else (0, 2, 0)
    np.testing.assert_allclose(moved, right, atol=1e-9)


def test_the_nominal_focal_length_of_a_turned_photograph_is_centred(tmp_path):
    for i in range(3):
        exif = Image.Exif()
        exif[0x0112] = 6
        exif.get_ifd(0x8769)[0xA405] = 28
        Image.fromarray(gradient_image(i, W, H)).save(tmp_path / f"{i}.jpg", exif=exif)
    camera = open_source(tmp_path, NATIVE).camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (H, W, (H - 1) / 2, (W - 1) / 2)
