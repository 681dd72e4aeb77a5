"""Times of images in a folder: in their names, in a list beside them, or assumed."""

import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.formats.image_times import time_in
from geogs.io.sources.sniff import open_source
from io_samples import write_images

NATIVE = InputConfig(intrinsics="50,50,31.5,23.5")
COUNT = 6
TENTHS = 0.1 * np.arange(COUNT)
NAMES = [f"{k:06d}.png" for k in range(COUNT)]


def read(folder) -> tuple[np.ndarray, tuple[str, ...], tuple[str, ...]]:
    """Times from the first on, what is said of them, and what is left."""
    source = open_source(folder, NATIVE)
    times = np.array([frame.timestamp for frame in source])
    said = tuple(line for line in source.account.used if line.startswith("times: "))
    return times - times[0], said, source.account.left


@pytest.mark.parametrize(
    "stem",
    [
        "1403636579.763555",
        "1403636579763555",
        "1403636579763555000",
        "14036365797635550",
        "1403636579_763555",
        "1403636579-763555000",
        "frame_1403636579763555",
        "cam0_1403636579.763555",
        "2014-06-24T19-02-59.763555",
        "20140624_190259763555",
        "IMG_20140624_190259_763555",
    ],
)
def test_a_time_of_the_epoch_in_a_name(stem):
    assert time_in(stem) == pytest.approx(1403636579.763555, abs=1e-6)


@pytest.mark.parametrize(
    "stem",
    [
        "000012",
        "frame12.5",
        "0000000000012",
        "1234567",
        "IMG_20140624_190259",
        "2014",
        "x" * 5000,
        "20149924_190259763",
        "DSC01234",
        "1000000017",
        "a1-" * 2000,
    ],
)
def test_names_that_are_no_times(stem):
    assert time_in(stem) is None


@pytest.mark.parametrize(
    "form",
    [
        lambda t: f"{t:.6f}",
        lambda t: f"{t * 1e3:.0f}",
        lambda t: f"frame_{t * 1e6:.0f}",
        lambda t: f"{int(t)}_{t % 1 * 1e9:09.0f}",
    ],
)
def test_folders_whose_names_are_times(tmp_path, form):
    times = 1.7e9 + np.array([0, 0.1, 0.2, 0.3, 3.5, 3.6])
    write_images(tmp_path, [f"{form(t)}.png" for t in times])
    found, said, _ = read(tmp_path)
    np.testing.assert_allclose(found, times - times[0], atol=1e-5)
    assert said == ("times: those in the names, 10 images a second, with a gap of 3.2 s",)


def test_assumed_times_are_said_and_so_are_missing_numbers(tmp_path):
    write_images(tmp_path / "all", NAMES)
    found, said, left = read(tmp_path / "all")
    np.testing.assert_allclose(found, np.arange(COUNT) / 30)
    assert (said, left) == (("times: 30 images a second assumed",), ())
    write_images(tmp_path / "fourth", [f"{4 * k:06d}.png" for k in range(COUNT)])
    assert read(tmp_path / "fourth")[1] == ("times: 30 images a second assumed",)
    write_images(tmp_path / "gap", [f"f{k}.png" for k in (0, 1, 2, 3, 9, 10, 12)])
    though = "times: 30 images a second assumed, though 6 of the numbers in their names are missing"
    assert read(tmp_path / "gap")[1] == (though,)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("times.txt", "".join(f"{t:e}\n" for t in TENTHS)),
        ("timestamps.txt", "".join(f"{1.7e9 + t:.3f}\n" for t in TENTHS)),
        (
            "timestamps.csv",
            "frame,timestamp_ms\n" + "".join(f"{k},{1000 * t:.0f}\n" for k, t in enumerate(TENTHS)),
        ),
        (
            "cam0_timestamps.csv",
            "#timestamp [ns],filename\r\n"
            + "".join(f"{1e18 + 1e9 * t:.0f},{n}\r\n" for t, n in zip(TENTHS, NAMES, strict=True)),
        ),
        (
            "frame_times.tsv",
            "# made by a recorder\nfile\ttime\n"
            + "".join(
                f"C:\\x\\{NAMES[k]}\t{1e6 * TENTHS[k]:.0f}\n" for k in reversed(range(COUNT))
            ),
        ),
        (
            "times.csv",
            "extra.png;9.5\n"
            + "".join(f"{n};{t:.3f}\n" for t, n in zip(TENTHS, NAMES, strict=True)),
        ),
    ],
)
@pytest.mark.parametrize("place", ["", "images"])
def test_a_list_beside_the_images_has_their_times(tmp_path, name, text, place):
    write_images(tmp_path / place, NAMES)
    (tmp_path / name).write_text(text, newline="")
    for folder in (tmp_path, tmp_path / place):
        found, said, left = read(folder)
        np.testing.assert_allclose(found, TENTHS, atol=1e-6)
        assert said == (f"times: those of {name}, 10 images a second",)
        assert left == ()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("0.0\n0.1\n0.2\n", "it has 3 rows for 6 images"),
        ("".join(f"{k}\n" for k in range(COUNT)), "no column of it rises like times"),
        ("".join(f"{t} a{k}.png\n" for k, t in enumerate(TENTHS)), "it names other images"),
        ("started at noon\n", "its rows are no table"),
        ("0.1\n0.2\n0.3\n0.4\n0.5\n1e999\n", "it has 5 rows for 6 images"),
        ("0.1\n" * COUNT, "no column of it rises like times"),
    ],
)
def test_a_list_that_cannot_be_used_is_named(tmp_path, text, reason):
    write_images(tmp_path, NAMES)
    (tmp_path / "times.txt").write_text(text)
    found, said, left = read(tmp_path)
    np.testing.assert_allclose(found, np.arange(COUNT) / 30)
    assert said == ("times: 30 images a second assumed",)
    assert left == (f"times.txt as times of the images: {reason}",)


def test_other_texts_are_no_lists_of_times(tmp_path):
    write_images(tmp_path, NAMES)
    (tmp_path / "runtime.txt").write_text("12\n")
    (tmp_path / "sentiment.csv").write_text("a,b\n")
    assert read(tmp_path)[2] == ()


def test_folders_with_two_images_of_every_time_are_numbered_and_say_so(tmp_path):
    stamps = [f"{1.7e9 + t:.3f}" for t in TENTHS]
    write_images(tmp_path, [f"cam{n}_{stamp}.png" for n in "01" for stamp in stamps])
    found, said, _ = read(tmp_path)
    np.testing.assert_allclose(found, np.arange(2 * COUNT) / 30)
    assert said[0].startswith("times: 30 images a second assumed")


def write_tum(folder, times: list[str]):
    write_images(folder, [f"rgb/{k}.png" for k in range(len(times))])
    rows = (f"{time} rgb/{k}.png\n" for k, time in enumerate(times))
    (folder / "rgb.txt").write_text("".join(rows))


def test_images_of_one_time_are_one_image(tmp_path):
    write_tum(tmp_path / "one", ["0.0", "0.1", "0.1", "0.2", "0.3", "0.300"])
    found, _, left = read(tmp_path / "one")
    np.testing.assert_allclose(found, [0, 0.1, 0.2, 0.3])
    assert left == ("2 of 6 images, which have the time of the one before (2.png, 5.png)",)
    write_tum(tmp_path / "whole", ["1", "1", "1", "2", "2", "2"])
    with pytest.raises(InputError, match="4 of 6 images have the time of the one before; give"):
        open_source(tmp_path / "whole", NATIVE)


@pytest.mark.parametrize(("unit", "rate"), [(1e3, "0.01"), (1e9, "1e-08"), (1e-4, "1e+05")])
def test_times_that_are_no_seconds_are_questioned(tmp_path, unit, rate):
    write_tum(tmp_path, [repr(float(unit * t)) for t in TENTHS])
    assert read(tmp_path)[1] == (f"times: {rate} images a second; are they in seconds?",)


def test_depth_beside_a_plain_folder_is_named(tmp_path):
    write_images(tmp_path, [f"rgb/{name}" for name in NAMES])
    write_images(tmp_path, [f"depth/{name}" for name in NAMES])
    for place in (tmp_path, tmp_path / "rgb"):
        (said,) = read(place)[2]
        assert said.startswith("pictures in depth: depth is read by lists (TUM's rgb.txt and")
