"""Bags of ROS 1 and ROS 2, written by the writers of ``rosbags``."""

import builtins
import re

import cv2
import numpy as np
import pytest

import geogs
from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.extras import install_command
from geogs.io.sources.ros.bag import is_bag
from io_samples import gradient_image

pytest.importorskip("rosbags", reason="bags need rosbags (pip install 'geogs[ros]')")
from bag_samples import BagWriter

NATIVE = InputConfig(long_edge=0)
KINDS = ["bag", "sqlite", "mcap"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "bgra8", "mono8", "mono16"])
def test_raw_images_with_their_times_and_camera(tmp_path, kind, encoding):
    with BagWriter(tmp_path, kind) as bag:
        for k in range(4):
            bag.camera_info("/camera/camera_info", k, distortion=(0.1, -0.02, 0.001, 0.002, 0.0))
            bag.image("/camera/image_raw", k, gradient_image(k), encoding, padding=5)
    source = geogs.open_source(bag.path, NATIVE)
    frames = list(source)
    assert (source.kind, source.length, source.place.skipped) == ("bag", 4, 0)
    assert source.fps == pytest.approx(20)
    np.testing.assert_allclose([f.timestamp for f in frames], 1000 + np.arange(4) / 20, atol=1e-6)
    calibration = source.calibration
    assert (calibration.fx, calibration.fy, calibration.cx, calibration.cy) == (50, 51, 31.5, 23.5)
    assert calibration.distortion == (0.1, -0.02, 0.001, 0.002, 0.0)
    assert calibration.origin == "/camera/camera_info of the bag"
    assert not source.is_calibration_open
    for k, raw in enumerate(source._recordings[0].reader.read(0, None, 1)):
        true = gradient_image(k)
        if encoding.startswith("mono"):
            true = np.repeat(cv2.cvtColor(true, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
        np.testing.assert_array_equal(raw.image, true)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("form", ["png", "jpeg"])
def test_compressed_images_and_a_selection(tmp_path, kind, form):
    with BagWriter(tmp_path, kind) as bag:
        bag.camera_info("/cam/camera_info", 0)
        for k in range(6):
            bag.compressed("/cam/image_raw/compressed", k, gradient_image(k), form)
    config = InputConfig(long_edge=0, start=1, stop=6, stride=2)
    source = geogs.open_source(bag.path, config)
    frames = list(source)
    np.testing.assert_allclose([f.timestamp for f in frames], [1000.05, 1000.15, 1000.25])
    for k, frame in zip((1, 3, 5), frames, strict=True):
        difference = np.abs(frame.image.astype(int) - gradient_image(k))
        assert difference.mean() < (0.01 if form == "png" else 3)
    assert source.camera.fx == 50


def test_the_folder_of_a_ros_2_bag_and_its_file_are_the_same(tmp_path):
    with BagWriter(tmp_path, "mcap") as bag:
        for k in range(3):
            bag.image("/image", k, gradient_image(k))
    inside = next(bag.path.glob("*.mcap"))
    whole, file = geogs.open_source(bag.path, NATIVE), geogs.open_source(inside, NATIVE)
    for one, other in zip(whole, file, strict=True):
        assert one.timestamp == other.timestamp
        np.testing.assert_array_equal(one.image, other.image)
    assert whole.is_calibration_open  # nobody described the camera
    assert whole.fingerprint() == file.fingerprint()


def test_bayer_patterns_are_named_by_their_first_row(tmp_path):
    red = np.zeros((48, 64), np.uint8)
    red[::2, ::2] = 200  # R G / G B
    with BagWriter(tmp_path, "bag") as bag:
        bag.image("/image", 0, red, "bayer_rggb8")
    image = next(iter(geogs.open_source(bag.path, NATIVE))).image
    np.testing.assert_array_equal(image[4:-4, 4:-4].reshape(-1, 3).max(axis=0), [200, 0, 0])


def as_bytes(deep: np.ndarray, order: str = "<") -> np.ndarray:
    """Values of 16 bits as the bytes of their rows."""
    return np.ascontiguousarray(deep.astype(f"{order}u2")).view(np.uint8).reshape(len(deep), -1)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize(
    ("encoding", "order"), [("rgb16", "<"), ("bgr16", "<"), ("mono16", ">"), ("16UC1", "<")]
)
def test_images_of_16_bits_are_read_by_the_bits_in_use(tmp_path, encoding, order, bits):
    with BagWriter(tmp_path, "mcap") as bag:
        for k in range(3):
            image = gradient_image(k)
            values = {"rgb16": image, "bgr16": image[..., ::-1]}.get(encoding, image[..., 1])
            rows = as_bytes(values.astype(np.uint16) << (bits - 8), order)
            bag.rows("/camera/image", k, rows, encoding, is_bigendian=order == ">")
    source = geogs.open_source(bag.path, NATIVE)
    image = list(source)[2].image
    true = gradient_image(2)
    expected = true if encoding in ("rgb16", "bgr16") else true[..., [1]]
    np.testing.assert_array_equal(image, np.broadcast_to(expected, true.shape))
    said = f"pictures use {bits} of their 16 bits"
    assert (said in source.account.used) == (bits < 16)


@pytest.mark.parametrize("kind", KINDS)
def test_a_thermal_camera_is_stretched_alike_in_all_images(tmp_path, kind):
    with BagWriter(tmp_path, kind) as bag:
        for k in range(4):
            bag.rows(
                "/flir/image_raw", k, as_bytes(gradient_image(k)[..., 1] + np.uint16(7400)), "16UC1"
            )
    images = [f.image for f in geogs.open_source(bag.path, NATIVE)]
    assert np.ptp(images[0]) > 190
    np.testing.assert_array_equal(images[0], images[3])


@pytest.mark.parametrize(("encoding", "swap"), [("nv12", False), ("nv21", True), ("i420", None)])
def test_images_with_rows_of_colour(tmp_path, encoding, swap):
    planes = cv2.cvtColor(gradient_image(9), cv2.COLOR_RGB2YUV_I420)
    if swap is not None:
        u, v = planes[48:].reshape(2, -1)
        colours = np.stack((v, u) if swap else (u, v), axis=1)
        planes = np.concatenate([planes[:48], colours.reshape(24, 64)])
    with BagWriter(tmp_path, "sqlite") as bag:
        bag.rows("/image", 0, planes, encoding)
    image = next(iter(geogs.open_source(bag.path, NATIVE))).image
    assert np.abs(image.astype(int) - gradient_image(9)).mean() < 4


@pytest.mark.parametrize(
    ("encoding", "at"), [("uyvy", 1), ("yuv422", 1), ("yuyv", 0), ("yuv422_yuy2", 0), ("yuy2", 0)]
)
def test_images_with_two_bytes_a_pixel(tmp_path, encoding, at):
    """Grey: brightness in every second byte, 128 in the others."""
    rows = np.full((48, 128), 128, np.uint8)
    rows[:, at::2] = np.linspace(16, 235, 64).astype(np.uint8)
    with BagWriter(tmp_path, "bag") as bag:
        bag.rows("/image", 0, rows, encoding)
    image = next(iter(geogs.open_source(bag.path, NATIVE))).image
    np.testing.assert_allclose(image[5, :, 0], np.linspace(0, 255, 64), atol=3)


@pytest.mark.parametrize(
    "encoding", ["bayer_rggb16", "bayer_bggr16", "bayer_gbrg16", "bayer_grbg16"]
)
def test_bayer_patterns_of_16_bits(tmp_path, encoding):
    at = encoding[6:10].index("r")
    red = np.zeros((48, 64), np.uint16)
    red[at // 2 :: 2, at % 2 :: 2] = 4000
    with BagWriter(tmp_path, "bag") as bag:
        bag.rows("/image", 0, as_bytes(red), encoding)
    image = next(iter(geogs.open_source(bag.path, NATIVE))).image
    np.testing.assert_array_equal(image[4:-4, 4:-4].reshape(-1, 3).max(axis=0), [250, 0, 0])


@pytest.mark.parametrize("has_camera", [False, True])
def test_colour_is_preferred_to_a_grey_fisheye_and_depth_is_no_image(tmp_path, has_camera):
    grey = np.repeat(gradient_image(0)[..., [1]], 3, axis=2)
    with BagWriter(tmp_path, "mcap") as bag:
        bag.camera_info("/fisheye/camera_info", 0, (0.1, 0.0, 0.0, 0.0), "equidistant")
        if has_camera:
            bag.camera_info("/color/camera_info", 0)
        for k in range(3):
            bag.image("/fisheye/image_raw", k, gradient_image(k), "mono8")
            bag.compressed("/a_grey/image/compressed", k, grey, "jpeg")
            bag.compressed("/color/image_raw/compressed", k, gradient_image(k), "jpeg")
            bag.depth("/aligned_depth/image_raw", k, np.full((48, 64), 1500, np.uint16))
    source = geogs.open_source(bag.path, NATIVE)
    assert source._recordings[0].reader.topic == "/color/image_raw/compressed"
    assert "images: topic /color/image_raw/compressed" in source.account.used
    assert source.account.left == (
        "images of /a_grey/image/compressed, /fisheye/image_raw: --topic takes another",
        "depth of /aligned_depth/image_raw: that of bags is not read",
    )
    with pytest.raises(InputError, match="/aligned_depth/image_raw shows depth, not images"):
        geogs.open_source(bag.path, InputConfig(topic="/aligned_depth/image_raw"))


def test_the_likeliest_topic_is_read_and_another_can_be_asked_for(tmp_path):
    with BagWriter(tmp_path, "sqlite") as bag:
        bag.camera_info("/d400/color/camera_info", 0)
        bag.camera_info("/d400/infra1/camera_info", 0)
        for k in range(4):
            bag.depth("/d400/depth/image_rect_raw", k, np.full((48, 64), 1500, np.uint16))
            bag.image("/d400/infra1/image_rect_raw", k, gradient_image(k), "mono8")
            bag.image("/debug/image", k, gradient_image(k))
            if k % 2:
                bag.image("/d400/color/image_raw", k, gradient_image(k))
    source = geogs.open_source(bag.path, NATIVE)
    assert (source._recordings[0].reader.topic, source.length) == ("/d400/color/image_raw", 2)
    asked = InputConfig(long_edge=0, topic="/debug/image")
    assert geogs.open_source(bag.path, asked).length == 4
    with pytest.raises(InputError, match="no images on that topic; it has: /d400/co"):
        geogs.open_source(bag.path, InputConfig(topic="/tf"))
    with pytest.raises(InputError, match="leave out --topic"):
        geogs.open_source(tmp_path, InputConfig(topic="/tf"))


def test_rectified_images_have_the_projection_matrix_and_no_distortion(tmp_path):
    with BagWriter(tmp_path, "bag") as bag:
        bag.camera_info("/left/camera_info", 0, distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
        bag.image("/left/image_rect_color", 0, gradient_image(0))
    source = geogs.open_source(bag.path, NATIVE)
    assert (source.camera.fx, source.camera.fy, source.camera.cx) == (40, 41, 30.5)
    assert not source.calibration.is_distorted


@pytest.mark.parametrize("kind", KINDS)
def test_the_lens_of_a_fisheye(tmp_path, kind):
    k = (-0.02, 0.004, -0.003, 0.0007)
    with BagWriter(tmp_path, kind) as bag:
        bag.camera_info("/camera_info", 0, distortion=k, model="equidistant")
        bag.image("/image", 0, gradient_image(0))
    calibration = geogs.open_source(bag.path, InputConfig(working_field_of_view=50.0)).calibration
    assert (calibration.lens, calibration.distortion) == ("fisheye", k)
    (tmp_path / "other").mkdir()
    with BagWriter(tmp_path / "other", kind) as bag:
        bag.camera_info("/camera_info", 0, distortion=k, model="omni")
        bag.image("/image", 0, gradient_image(0))
    with pytest.raises(InputError, match="not supported; undistort"):
        geogs.open_source(bag.path)


def test_a_region_of_interest_and_binning(tmp_path):
    """K is that of the whole sensor, 128 x 96; the images are its lower right, by two pixels."""
    with BagWriter(tmp_path, "sqlite") as bag:
        bag.camera_info("/camera_info", 0, size=(256, 192), roi=(64, 96, 128, 96), binning=2)
        bag.image("/image", 0, gradient_image(0))
    camera = geogs.open_source(bag.path, NATIVE).camera
    # The pixel at x of the sensor is at (x - 64 + 1/2) / 2 - 1/2 of the images.
    assert (camera.fx, camera.fy) == (100, 102)
    assert camera.cx == pytest.approx((127.5 - 64 + 0.5) / 2 - 0.5)
    assert camera.cy == pytest.approx((95.5 - 96 + 0.5) / 2 - 0.5)


def test_damaged_messages_and_times_that_do_not_increase_are_skipped(tmp_path):
    with BagWriter(tmp_path, "mcap") as bag:
        for k in range(5):
            bag.compressed("/image/compressed", k, gradient_image(k), "png", damaged=k == 1)
        bag.image_at("/image/compressed", 4)
    source = geogs.open_source(bag.path, NATIVE)
    assert len(list(source)) == 4
    assert source.place.skipped == 2


def test_an_unset_stamp_is_when_the_message_was_received(tmp_path):
    with BagWriter(tmp_path, "bag") as bag:
        for k in range(2):
            bag.image("/image", k, gradient_image(k), is_stamped=False)
    times = [f.timestamp for f in geogs.open_source(bag.path, NATIVE)]
    np.testing.assert_allclose(times, [1000.0, 1000.05], atol=1e-6)


def test_bags_that_cannot_be_read_say_so(tmp_path, monkeypatch):
    with BagWriter(tmp_path, "bag") as bag:
        bag.depth("/depth", 0, np.full((48, 64), 1500, np.uint16))
    with pytest.raises(InputError, match="holds no topic with images; topics with some: /depth"):
        geogs.open_source(bag.path)
    cut = tmp_path / "cut.bag"
    cut.write_bytes(bag.path.read_bytes()[:100])
    assert is_bag(cut)
    with pytest.raises(InputError, match=r"cut\.bag cannot be opened as a recording of ROS"):
        geogs.open_source(cut)
    other = tmp_path / "other.bag"
    other.write_bytes(b"nothing of the kind")
    assert not is_bag(other)

    load = builtins.__import__

    def without(name, *rest):
        if name.startswith("rosbags"):
            raise ImportError(name)
        return load(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=re.escape(install_command("ros"))):
        geogs.open_source(bag.path)


def test_a_damaged_first_message_hides_no_topic(tmp_path):
    with BagWriter(tmp_path, "mcap") as bag:
        bag.broken("/image/compressed", -1)
        for k in range(3):
            bag.compressed("/image/compressed", k, gradient_image(k), "png")
    source = geogs.open_source(bag.path, NATIVE)
    assert len(list(source)) == 3
    assert source.place.skipped == 1
