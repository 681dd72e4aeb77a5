"""Image sequences: recognition, order, times, selection, working images."""

import json
import logging
import threading

import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.formats.image_files import natural_key, time_from_name
from geogs.io.sources.reader import read_ahead
from geogs.io.sources.sniff import open_source
from io_samples import gradient_image, write_image, write_images

NATIVE = InputConfig(intrinsics="50,50,31.5,23.5", long_edge=0)


def reds(source) -> list[int]:
    """The frame number that each image carries, see ``gradient_image``."""
    return [round(float(frame.image[..., 0].mean()) / 10) for frame in source]


def test_image_folder_in_natural_order_with_nominal_times(tmp_path):
    write_images(tmp_path, [f"view{i}.png" for i in range(12)])
    source = open_source(tmp_path, NATIVE)
    frames = list(source)
    assert (source.kind, source.length, source.place.skipped) == ("images", 12, 0)
    assert source.name == tmp_path.name
    assert source.fps == pytest.approx(30)
    assert [frame.index for frame in frames] == list(range(12))
    np.testing.assert_allclose([frame.timestamp for frame in frames], np.arange(12) / 30)
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, gradient_image(i))  # RGB, untouched
    assert (source.camera.fx, source.camera.width, source.camera.height) == (50, 64, 48)


def test_selection_keeps_the_times_of_the_source(tmp_path):
    write_images(tmp_path, [f"{i:03d}.png" for i in range(10)])
    config = InputConfig(intrinsics="50,50,31.5,23.5", start=2, stop=9, stride=3)
    source = open_source(tmp_path, config)
    frames = list(source)
    assert reds(source) == [2, 5, 8]
    assert [frame.index for frame in frames] == [0, 1, 2]
    np.testing.assert_allclose([frame.timestamp for frame in frames], np.array([2, 5, 8]) / 30)
    assert source.length == 3
    assert source.fps == pytest.approx(10)
    assert open_source(tmp_path, InputConfig(stop=100)).length == 10


def test_names_that_are_times(tmp_path):
    write_images(tmp_path / "tum", ["1305031102.5.png", "1305031102.25.png"])
    frames = list(open_source(tmp_path / "tum", NATIVE))
    assert [frame.timestamp for frame in frames] == [1305031102.25, 1305031102.5]
    write_images(tmp_path / "euroc", ["1403636579763555584.png", "1403636579813555456.png"])
    frames = list(open_source(tmp_path / "euroc", NATIVE))
    assert frames[1].timestamp - frames[0].timestamp == pytest.approx(0.05, abs=1e-5)
    assert time_from_name("0000000000012") is None
    assert time_from_name("frame12.5") is None


def test_natural_key_orders_numbers_inside_names():
    names = ["a10", "a9", "a1b2", "a1", "b0", "7"]
    assert sorted(names, key=natural_key) == ["7", "a1", "a1b2", "a9", "a10", "b0"]
    long, longer = "9" * 5000, "1" + "0" * 5000  # too long for Python to make numbers of
    assert sorted([longer, long, "007", "6", "8"], key=natural_key) == [
        "6", "007", "8", long, longer,
    ]  # fmt: skip


def test_working_image_is_shrunk_with_its_camera(tmp_path):
    write_images(tmp_path, ["a.png", "b.png"], width=64, height=48)
    source = open_source(tmp_path, InputConfig(intrinsics="50,50,31.5,23.5", long_edge=32))
    frame = next(iter(source))
    assert frame.image.shape == (24, 32, 3)
    assert frame.image.flags.c_contiguous
    assert (source.camera.fx, source.camera.cx, source.camera.cy) == (25, 15.5, 11.5)
    block_mean = gradient_image(0).reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(frame.image, block_mean, atol=0.6)


def test_images_in_a_sub_folder_with_their_calibration_above(tmp_path):
    write_images(tmp_path / "images", ["a.png", "b.png"])
    (tmp_path / "transforms.json").write_text(
        json.dumps({"fl_x": 70, "fl_y": 71, "cx": 32, "cy": 24, "w": 64, "h": 48, "frames": []})
    )
    for place in (tmp_path, tmp_path / "images"):
        source = open_source(place, InputConfig())
        assert (source.camera.fx, source.camera.fy, source.camera.cx) == (70, 71, 31.5)
        assert source.intrinsics_origin.endswith("transforms.json")


def test_replica_layout_needs_no_poses_and_finds_the_camera_beside_or_above(tmp_path):
    scene = tmp_path / "room0"
    write_images(scene / "results", [f"frame{i:06d}.jpg" for i in (0, 1, 4)])
    write_image(scene / "results" / "depth000000.png", gradient_image(9))
    camera = {"camera": {"w": 64, "h": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}}
    (tmp_path / "cam_params.json").write_text(json.dumps(camera))
    for place in (scene, scene / "results"):
        source = open_source(place, InputConfig(long_edge=0))
        assert (source.kind, source.name, source.length) == ("replica", "room0", 3)
        assert source.camera.fx == 60
        np.testing.assert_allclose([f.timestamp for f in source], np.array([0, 1, 4]) / 30)
    camera["camera"]["fx"] = 61.0
    (scene / "cam_params.json").write_text(json.dumps(camera))
    assert open_source(scene, InputConfig(long_edge=0)).camera.fx == 61


def test_replica_camera_is_known_without_a_file(tmp_path):
    write_images(tmp_path / "office1" / "results", ["frame000000.jpg"], 1200, 680)
    source = open_source(tmp_path / "office1", InputConfig(long_edge=0))
    assert (source.camera.fx, source.camera.cx, source.camera.cy) == (600, 599.5, 339.5)


def test_tum_layout_with_its_times_and_distortion(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg1_desk"
    write_images(folder / "rgb", ["a.png", "b.png", "c.png"], 640, 480)
    (folder / "rgb.txt").write_text(
        "# color images\n1305031102.2 rgb/b.png\n1305031102.1 rgb/a.png\n1305031103.0 rgb/c.png\n"
    )
    source = open_source(folder, InputConfig(long_edge=0))
    frames = list(source)
    assert source.kind == "tum"
    assert [frame.timestamp for frame in frames] == [1305031102.1, 1305031102.2, 1305031103.0]
    assert source.calibration.fx == pytest.approx(517.306408)
    assert source.calibration.is_distorted
    assert source.camera.fx >= source.calibration.fx  # cropped, not blackened
    (folder / "rgb.txt").write_text("1305031102.2 rgb/b.png extra\n")
    with pytest.raises(InputError, match="line 1: expected a time and a file"):
        open_source(folder)


def test_seven_scenes_sequence_or_scene(tmp_path):
    scene = tmp_path / "redkitchen"
    names = [f"frame-{i:06d}.color.jpg" for i in (0, 3)]
    write_images(scene / "seq-01", names, 640, 480)
    write_image(scene / "seq-01" / "frame-000000.depth.png", gradient_image(0))
    for place in (scene, scene / "seq-01"):
        source = open_source(place, InputConfig(long_edge=0))
        assert (source.kind, source.length) == ("7scenes", 2)
        assert (source.camera.fx, source.camera.cx) == (525, 320)
        np.testing.assert_allclose([f.timestamp for f in source], [0, 0.1])
    write_images(scene / "seq-02", names, 640, 480)
    with pytest.raises(InputError, match="several sequences; give one of seq-01, seq-02"):
        open_source(scene)


def test_given_intrinsics_win_over_the_data_set(tmp_path):
    write_images(tmp_path / "seq-01", ["frame-000000.color.jpg"], 640, 480)
    source = open_source(tmp_path, InputConfig(intrinsics="400,401,300,200", long_edge=0))
    assert (source.camera.fx, source.camera.fy, source.intrinsics_origin) == (400, 401, "as given")


def test_unreadable_images_are_skipped_and_counted(tmp_path, caplog):
    write_images(tmp_path, [f"{i}.jpg" for i in range(5)])
    (tmp_path / "0.jpg").write_bytes(b"")
    (tmp_path / "3.jpg").write_bytes((tmp_path / "3.jpg").read_bytes()[:300])
    source = open_source(tmp_path, NATIVE)
    with caplog.at_level(logging.WARNING, logger="geogs"):
        frames = list(source)
    assert source.place.skipped == 2
    assert [frame.index for frame in frames] == [0, 1, 2]
    np.testing.assert_allclose([f.timestamp * 30 for f in frames], [1, 2, 4])  # not shifted
    assert "0.jpg cannot be read; skipped" in caplog.text
    assert "skipped 2 images" in caplog.text
    assert len(list(source)) == 3  # again from the start


def test_reading_ahead_makes_the_next_item_meanwhile_and_passes_errors_on():
    made = [threading.Event() for _ in range(5)]

    def items():
        for i, event in enumerate(made):
            event.set()
            yield i
        raise ValueError("at the end")

    seen = []

    def consume() -> None:
        for item in read_ahead(items()):
            seen.append(item)
            if item + 1 < len(made):
                assert made[item + 1].wait(timeout=600)  # without being asked for

    with pytest.raises(ValueError, match="at the end"):
        consume()
    assert seen == [0, 1, 2, 3, 4]


def test_iteration_can_be_left_early(tmp_path):
    write_images(tmp_path, [f"{i}.png" for i in range(6)])
    source = open_source(tmp_path, NATIVE)
    for frame in source:
        if frame.index == 1:
            break
    assert reds(source) == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("name", "kind", "length", "size", "fx"),
    [
        ("rooms/living-room-2", "replica", 400, (512, 290), 256.0),
        ("replica/room0-first10", "replica", 10, (512, 290), 256.0),
        ("7scenes-redkitchen", "7scenes", 500, (512, 384), 420.0),
        ("dtu/scan24", "images", 49, (512, 384), 443.4),
    ],
)
def test_shared_sequences(shared_data, name, kind, length, size, fx):
    source = open_source(shared_data / name)
    camera = source.camera
    assert (source.kind, source.length) == (kind, length)
    assert (camera.width, camera.height) == size
    assert camera.fx == pytest.approx(fx, abs=0.01)
    assert next(iter(source)).image.shape == (size[1], size[0], 3)
