"""Pictures in a folder that are no frames: depth, masks, previews, strays, kinds not read."""

import numpy as np
import pytest
from PIL import Image

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.sniff import open_source
from geogs_photos.photograph import find_photographs
from io_samples import write_images

NATIVE = InputConfig(intrinsics="50,50,31.5,23.5", long_edge=0)
TIMES = [f"17000000{i:02d}.5.png" for i in range(10)]
NUMBERS = [f"frame_{i:04d}.png" for i in range(10)]


def names(source) -> list[str]:
    """The names of the files that are frames."""
    return [path.name for path in source._recordings[0].reader.paths]


@pytest.mark.parametrize(
    ("colour", "other", "said"),
    [
        ("{:05d}-color.png", "{:05d}-depth.png", "of depth by the names"),
        ("{:04d}.jpg", "{:04d}_mask.png", "of masks by the names"),
        ("rgb_{:04d}.png", "depth_{:04d}.png", "of depth by the names"),
        ("frame{}.jpg", "depth{:06d}.png", "of depth by the names"),
        ("IMG_{:03d}.jpg", "IMG_{:03d}.seg.png", "of labels by the names"),
        ("{:03d}-rgb.png", "{:03d}-ir.png", "of infrared by the names"),
        ("left_{:03d}.png", "right_{:03d}.png", "of the right camera by the names"),
    ],
)
def test_only_the_colour_images_of_a_folder_are_frames(tmp_path, colour, other, said):
    images = [colour.format(i) for i in range(8)]
    write_images(tmp_path, images)
    write_images(tmp_path, [other.format(i) for i in range(6)])
    source = open_source(tmp_path, NATIVE)
    assert names(source) == images
    assert said in source.account.left[0]
    assert source.account.left[0].startswith("6 pictures (")
    kept = find_photographs(tmp_path)
    if "right" in other:  # which are as good as the left ones
        assert len(kept.photographs) == 14
        return
    assert [p.name for p in kept.photographs] == images
    assert said in kept.account.left[0]


def test_depth_and_colour_of_unequal_times(tmp_path):
    write_images(tmp_path, [f"17000000{i:02d}.50-color.png" for i in range(6)])
    write_images(tmp_path, [f"17000000{i:02d}.53-depth.png" for i in range(6)])
    frames = list(open_source(tmp_path, NATIVE))
    np.testing.assert_allclose([f.timestamp for f in frames], 1.7e9 + np.arange(6) + 0.5)


@pytest.mark.parametrize(
    "images",
    [
        [f"depth_{i}.png" for i in range(6)],
        [f"thermal{i}.png" for i in range(6)],
        [f"right_{i}.png" for i in range(6)],
        ["chair left.jpg", "chair right.jpg", "table left.jpg", "table right.jpg"],
        ["mask shop.jpg", "normal road.jpg", "a.jpg", "b.jpg", "c.jpg"],
        ["hall1.jpg", "hall2.jpg", "hall3.jpg", "hall4.jpg", "hall5.jpg", "entry.jpg"],
        ["12.5.png", "13.5.png", "cover.png"],
    ],
)
def test_images_without_others_are_all_frames(tmp_path, images):
    write_images(tmp_path, images)
    source = open_source(tmp_path, NATIVE)
    assert sorted(names(source)) == sorted(images)
    assert source.account.left == ()


@pytest.mark.parametrize(
    "stray", [["preview.jpg"], ["cover.png", "0001.png"], [TIMES[3][:-4] + ".jpg"]]
)
def test_names_that_are_times_stay_so_beside_strays(tmp_path, stray):
    write_images(tmp_path, TIMES + stray)
    source = open_source(tmp_path, NATIVE)
    times = [frame.timestamp for frame in source]
    np.testing.assert_allclose(times, 1.7e9 + np.arange(10) + 0.5)
    assert source.account.left[0].endswith("not named like the others")


@pytest.mark.parametrize("stray", ["preview.jpg", "a cover.png", "sheet2.png"])
def test_a_stray_picture_of_another_name_and_size_is_no_frame(tmp_path, stray):
    write_images(tmp_path, NUMBERS)
    write_images(tmp_path, [stray], 32, 24)
    source = open_source(tmp_path, NATIVE)
    assert names(source) == NUMBERS
    assert source.account.left == (f"1 picture ({stray}), not named like the others",)


@pytest.mark.parametrize("ending", ["heic", "HEIF", "jxl", "gif", "psd", "webm"])
def test_pictures_of_a_kind_that_is_not_read_are_counted(tmp_path, ending):
    write_images(tmp_path, [f"IMG_{i}.jpg" for i in range(3)])
    for i in range(3, 7):
        (tmp_path / f"IMG_{i}.{ending}").write_bytes(b"something")
    (tmp_path / f"IMG_1.{ending}").write_bytes(b"beside a JPEG")
    (tmp_path / "notes.txt").write_text("hello")
    for account in (open_source(tmp_path, NATIVE).account, find_photographs(tmp_path).account):
        (line,) = account.left
        assert line.startswith(f"4 .{ending.lower()} files are not read here: ")


@pytest.mark.parametrize("ending", ["heic", "dng", "CR3", "jxl"])
@pytest.mark.parametrize("below", ["", "images"])
def test_a_folder_of_such_alone_is_refused_with_the_way_out(tmp_path, ending, below):
    (tmp_path / below).mkdir(exist_ok=True)
    for i in range(4):
        (tmp_path / below / f"IMG_{i}.{ending}").write_bytes(b"something")
    said = f"holds no images that can be read: 4 .{ending.lower()} files are not read here: .* JPEG"
    with pytest.raises(InputError, match=said):
        open_source(tmp_path, NATIVE)
    with pytest.raises(InputError, match=said):
        find_photographs(tmp_path)


def test_avif_is_read(tmp_path):
    for i in range(3):
        Image.new("RGB", (64, 48), (10 + 80 * i, 90, 60)).save(tmp_path / f"{i}.avif")
    source = open_source(tmp_path, NATIVE)
    assert [round(float(f.image[..., 0].mean())) for f in source] == pytest.approx(
        [10, 90, 170], abs=3
    )
