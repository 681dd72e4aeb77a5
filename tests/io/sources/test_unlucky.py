"""What a hostile or unlucky user gives: odd images, names and numbers; each used or refused."""

import os

import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.guard.atomic import write_text
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.sniff import open_source
from io_samples import gradient_image, write_image, write_images, write_video

GIVEN = InputConfig(intrinsics="50,50,31.5,23.5")


def damage(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 40] = bytes(40)
    path.write_bytes(data)


def test_damaged_images_are_used_counted_and_told_once(tmp_path, caplog):
    write_images(tmp_path, [f"{i}.jpg" for i in range(5)], 320, 240)
    for number in (1, 3):
        damage(tmp_path / f"{number}.jpg")
    source = open_source(tmp_path, InputConfig(intrinsics="300,300,160,120"))
    with caplog.at_level("WARNING", "geogs"):
        places = [source.place for _ in source]
    assert len(places) == 5
    assert (source.place.damaged, source.place.skipped) == (2, 0)
    assert caplog.messages == [
        f"{tmp_path / '1.jpg'} is damaged; used as far as it goes.",
        f"{tmp_path.name}: 2 images are damaged.",
    ]
    assert len(list(source.frames_after(places[1]))) == 3
    assert source.place.damaged == 2


@pytest.mark.parametrize("size", [(1, 1), (3, 5000), (5000, 3), (11, 200)])
def test_images_too_small_for_anything_are_refused(tmp_path, size):
    write_image(tmp_path / "a.png", np.zeros((*size[::-1], 3), np.uint8))
    with pytest.raises(InputError, match=r"both sides need 12 at least"):
        open_source(tmp_path)


@pytest.mark.parametrize("listed", ["pipe.png", "folder.png", "/dev/zero", "none.png", "a\0.png"])
def test_a_listed_file_that_is_no_plain_one_is_skipped(tmp_path, listed):
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "folder.png").mkdir()
    write_image(tmp_path / "b.png", gradient_image(0))
    (tmp_path / "rgb.txt").write_text(f"1.0 {listed}\n2.0 b.png\n")
    source = open_source(tmp_path, GIVEN)
    assert [frame.timestamp for frame in source] == [2.0]
    assert source.place.skipped == 1


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ("1e9,1e9,31.5,23.5", r"plausible are 6\.4 to 6400"),
        ("1e-9,1e-9,31.5,23.5", r"plausible are 6\.4 to 6400"),
        ("50,500,31.5,23.5", "about the same in both directions"),
        ("50,50,31.5,23.5,1e9,0,0,0", "distortion numbers that no lens has"),
        ("50,50,31.5,23.5,1", "hold 5 numbers"),
        ("1e400,50,31.5,23.5", "NaN or infinity"),
    ],
)
def test_intrinsics_that_no_camera_has(tmp_path, numbers, said):
    write_image(tmp_path / "a.png", gradient_image(0))
    with pytest.raises(InputError, match=said):
        open_source(tmp_path, InputConfig(intrinsics=numbers))


@pytest.mark.parametrize("count", [1, 2, 3, 6, 7, 11])
def test_distortion_has_as_many_numbers_as_opencv_takes(count):
    with pytest.raises(InputError, match=f"have {count} distortion numbers"):
        Calibration(50.0, 50.0, 31.5, 23.5, (0.01,) * count)


@pytest.mark.parametrize("width", [0, -1, 1 << 30])
def test_images_of_a_size_that_there_is_not(width):
    with pytest.raises(InputError, match="which there are not"):
        Calibration(50.0, 50.0, 31.5, 23.5, (), width, 48)


def test_intrinsics_in_another_unit_are_the_same_camera(tmp_path):
    write_image(tmp_path / "a.png", gradient_image(0))
    (tmp_path / "large.json").write_text(
        '{"fx": 150, "fy": 150, "cx": 95.5, "cy": 71.5, "width": 192, "height": 144}'
    )
    (tmp_path / "own.json").write_text(
        '{"fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}'
    )
    one, other = (
        open_source(tmp_path, InputConfig(intrinsics=str(tmp_path / name))).camera
        for name in ("large.json", "own.json")
    )
    assert one == other


def test_a_video_whose_tags_are_no_text_is_read(tmp_path):
    frames = [gradient_image(i) for i in range(4)]
    path = write_video(tmp_path / "v.mkv", frames, title="A title of some length")
    data = path.read_bytes()
    assert b"A title" in data
    path.write_bytes(data.replace(b"A title", b"\xff\xfe\xfd\xc3\x28\x80\x80"))
    assert len(list(open_source(path, GIVEN))) == 4


def test_names_that_are_no_utf8(tmp_path):
    folder = tmp_path / os.fsdecode(b"r\xf6om")
    write_images(tmp_path / "plain", ["a.png", "b.png"]).rename(folder)
    source = open_source(folder, GIVEN)
    assert len(list(source)) == 2
    write_text(tmp_path / "report.html", f"<h1>{source.name}</h1>")
    assert (tmp_path / "report.html").read_text() == "<h1>r\\udcf6om</h1>"
