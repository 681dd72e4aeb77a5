"""Image sets with known poses: one camera for all images, selection, masks, invalid poses."""

import json

import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.formats.nerfstudio import open_nerfstudio
from geogs.io.sources.posed.one_camera import OneCamera
from geogs.io.sources.sniff import open_posed_source
from io_samples import gradient_image, write_image

NATIVE = InputConfig(long_edge=0)


def write_replica(folder, poses, size=(64, 48)):
    for i in range(len(poses)):
        write_image(folder / "results" / f"frame{i:06d}.png", gradient_image(i, *size))
    np.savetxt(folder / "traj.txt", np.reshape(poses, (-1, 16)), fmt="%.17g")
    camera = {"w": size[0], "h": size[1], "fx": 60.0, "fy": 59.0, "cx": 31.0, "cy": 23.0}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder


def moves(n):
    """Camera to world, one step to the right each."""
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = np.arange(n)
    return poses


def test_replica(tmp_path):
    source = open_posed_source(write_replica(tmp_path / "room", moves(4)), NATIVE)
    assert (source.kind, source.name, len(source), source.scene_scale) == (
        "replica", "room", 4, "metres",
    )  # fmt: skip
    assert (source.camera.fx, source.camera.cy, source.camera.width) == (60.0, 23.0, 64)
    np.testing.assert_allclose(source.T_cw[:, 0, 3], [0, -1, -2, -3])
    for i, view in enumerate(source):
        assert (view.index, view.mask) == (i, None)
        np.testing.assert_array_equal(view.image, gradient_image(i))
        np.testing.assert_array_equal(view.T_cw, source.T_cw[i])
    np.testing.assert_allclose(source.timestamps, np.arange(4) / 30)


def test_selection_and_working_size(tmp_path):
    write_replica(tmp_path, moves(7))
    config = InputConfig(long_edge=32, start=1, stop=6, stride=2)
    source = open_posed_source(tmp_path, config)
    np.testing.assert_allclose(source.T_cw[:, 0, 3], [-1, -3, -5])
    assert source[-1].image.shape == (24, 32, 3)
    assert source.camera.fx == pytest.approx(30)
    assert source.camera.cx == pytest.approx(15.25)
    with pytest.raises(IndexError):
        source[3]


def test_invalid_poses_are_left_out(tmp_path, caplog):
    poses = moves(5)
    poses[1, 0, 0] = np.nan
    poses[3] = 0
    source = open_posed_source(write_replica(tmp_path, poses), NATIVE)
    np.testing.assert_allclose(source.T_cw[:, 0, 3], [0, -2, -4])
    assert "dropped 2 of 5 poses" in caplog.text


def test_folder_without_poses(tmp_path):
    write_image(tmp_path / "a.png", gradient_image(0))
    with pytest.raises(InputError, match="no images with known poses"):
        open_posed_source(tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        open_posed_source(tmp_path / "nowhere")


def write_transforms(folder, images, cameras):
    """``images`` in the folder, the camera of each with pixel centres at one half."""
    frames = []
    for i, (image, camera) in enumerate(zip(images, cameras, strict=True)):
        write_image(folder / f"{i}.png", image)
        frames.append({"file_path": f"{i}.png", "transform_matrix": np.eye(4).tolist(), **camera})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return folder


def pattern(fl_x, fl_y, cx, cy, w, h):
    """What a camera sees of a smooth pattern at infinity."""
    x = (np.arange(w) + 0.5 - cx) / fl_x
    y = (np.arange(h)[:, None] + 0.5 - cy) / fl_y
    colours = [np.sin(9 * x + 4 * y + k) * np.cos(7 * y - 3 * x) for k in range(3)]
    return np.rint(127.5 + 120 * np.stack(colours, -1)).astype(np.uint8)


FIRST = {"fl_x": 120.0, "fl_y": 121.0, "cx": 80.5, "cy": 59.5, "w": 160, "h": 120}


@pytest.mark.parametrize("long_edge", [0, 80])
@pytest.mark.parametrize(
    "other",
    [
        FIRST | {"fl_x": 126.0, "fl_y": 125.0, "cx": 83.0, "cy": 58.0},
        {"fl_x": 250.0, "fl_y": 248.0, "cx": 162.0, "cy": 121.0, "w": 324, "h": 244},
        {"fl_x": 100.0, "fl_y": 100.0, "cx": 70.5, "cy": 53.0, "w": 140, "h": 107},
    ],
)
def test_other_cameras_are_resampled_into_the_first(other, long_edge, tmp_path):
    cameras = [FIRST, other]
    write_transforms(tmp_path, [pattern(**camera) for camera in cameras], cameras)
    first, second = open_posed_source(tmp_path, InputConfig(long_edge=long_edge))
    assert second.image.shape == first.image.shape
    seen = np.ones(first.image.shape[:2], bool) if second.mask is None else second.mask
    assert seen.mean() > 0.85
    difference = np.abs(first.image.astype(float) - second.image)[seen]
    assert difference.mean() < 1.5
    assert np.percentile(difference, 99) < 8
    shifted = np.abs(first.image[:, 1:].astype(float) - second.image[:, :-1]).mean()
    assert shifted > 3 * difference.mean()


def test_images_of_one_strongly_distorted_lens_are_alike(tmp_path):
    bent = FIRST | {"fl_x": 80.0, "fl_y": 80.0, "k1": 0.5}
    write_transforms(tmp_path, [pattern(**FIRST)] * 2, [bent] * 2)
    files = open_nerfstudio(tmp_path).files
    assert OneCamera(files, NATIVE).unlike() == {}


def test_pixels_that_a_camera_does_not_see_are_masked(tmp_path):
    narrower = FIRST | {"fl_x": 132.0, "fl_y": 133.1}
    cameras = [FIRST, narrower]
    write_transforms(tmp_path, [pattern(**camera) for camera in cameras], cameras)
    first, second = open_posed_source(tmp_path, NATIVE)
    assert first.mask is None
    assert second.mask.mean() == pytest.approx(1 / 1.1**2, abs=0.03)
    assert second.mask[60, 80]
    assert not second.mask[0, 0]


@pytest.mark.parametrize(
    "other",
    [
        FIRST | {"fl_x": 200.0, "fl_y": 200.0},
        FIRST | {"fl_x": 160.0, "fl_y": 160.0, "cx": 60.5, "cy": 79.5, "w": 120, "h": 160},
        {key: value / 2 for key, value in FIRST.items()} | {"w": 80, "h": 60},
    ],
    ids=["zoomed", "upright", "half the resolution"],
)
def test_images_by_quite_another_camera_are_left_out(other, tmp_path):
    cameras = [FIRST, FIRST, other]
    write_transforms(tmp_path, [pattern(**camera) for camera in cameras], cameras)
    source = open_posed_source(tmp_path, NATIVE)
    assert len(source) == len(source.T_cw) == 2
    assert "1 of 3 images, taken with quite another camera" in source.account.left[0]
    write_transforms(tmp_path, [pattern(**camera) for camera in cameras[1:]], cameras[1:])
    with pytest.raises(InputError, match="hardly two of its 2 images are by one camera"):
        open_posed_source(tmp_path, NATIVE)


def test_upright_photographs_among_wide_ones_are_cropped(tmp_path):
    upright = FIRST | {"cx": 60.5, "cy": 79.5, "w": 120, "h": 160}
    cameras = [FIRST, FIRST, upright, upright]
    write_transforms(tmp_path, [pattern(**camera) for camera in cameras], cameras)
    source = open_posed_source(tmp_path, NATIVE)
    first, _, second, _ = source
    assert "2 of 4 images by other cameras" in source.account.left[0]
    # Columns 20 to 139 and one more on each side, half of which is seen.
    assert second.mask.sum(axis=1).tolist() == pytest.approx([120] * 120, abs=2)
    np.testing.assert_allclose(second.image[:, 22:138], first.image[:, 22:138], atol=1)


def test_distorted_cameras_that_differ(tmp_path):
    """Two lenses: straight lines are straight for both, at the same place."""
    lens = {"k1": 0.08, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    cameras = [FIRST | lens, FIRST | lens | {"k1": 0.05}]
    images = []
    for camera in cameras:
        y, x = np.mgrid[:120, :160] + 0.5
        points = np.stack([x - 80.5, y - 59.5], -1) / (120.0, 121.0)
        rays = points.copy()
        for _ in range(20):  # inverse of the radial distortion
            rays = points / (1 + camera["k1"] * (rays**2).sum(-1, keepdims=True))
        images.append(np.repeat(127.5 + 120 * np.sin(9 * rays[..., :1]), 3, -1).astype(np.uint8))
    write_transforms(tmp_path, images, cameras)
    first, second = open_posed_source(tmp_path, NATIVE)
    assert np.abs(first.image.astype(float) - second.image).mean() < 1
    # A column has one colour: the pattern depends on x alone.
    assert first.image[..., 0].astype(float).std(axis=0).max() < 3


def test_given_intrinsics_win(tmp_path):
    write_replica(tmp_path, moves(2))
    source = open_posed_source(tmp_path, InputConfig(intrinsics="50,51,30,20", long_edge=0))
    assert (source.camera.fx, source.camera.fy, source.camera.cx) == (50, 51, 30)
    assert source.intrinsics_origin == "as given"


def test_orientation_of_photographs_is_ignored(tmp_path):
    """Poses hold for the stored pixels, which EXIF may ask viewers to turn."""
    from PIL import Image

    folder = write_transforms(tmp_path, [pattern(**FIRST)], [FIRST])
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pattern(**FIRST)).save(folder / "0.jpg", exif=exif, quality=95)
    (folder / "0.png").unlink()
    document = json.loads((folder / "transforms.json").read_text().replace("0.png", "0.jpg"))
    (folder / "transforms.json").write_text(json.dumps(document))
    image = open_posed_source(folder, NATIVE)[0].image
    assert image.shape == (120, 160, 3)
    assert np.abs(image.astype(float) - pattern(**FIRST)).mean() < 5


def test_image_that_is_cut_off(tmp_path):
    write_replica(tmp_path, moves(3))
    file = tmp_path / "results" / "frame000001.png"
    file.write_bytes(file.read_bytes()[:60])
    source = open_posed_source(tmp_path, NATIVE)
    source[0]
    with pytest.raises(InputError, match=r"frame000001\.png is damaged"):
        source[1]


def test_bad_selection(tmp_path):
    with pytest.raises(InputError, match="images 9 to None of its 3 are none"):
        open_posed_source(write_replica(tmp_path, moves(3)), InputConfig(start=9))
