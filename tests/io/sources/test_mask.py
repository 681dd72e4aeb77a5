"""The mask of a source, straightened as its images are."""

import cv2
import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.sniff import open_source
from io_samples import gradient_image, write_video

LENS = "80,80,63.5,47.5,-0.3,0.05,0,0"


@pytest.fixture
def folder(tmp_path):
    """Three images, white above a line and black below it."""
    image = np.full((96, 128, 3), 255, np.uint8)
    image[70:] = 0
    for n in range(3):
        cv2.imwrite(str(tmp_path / f"{n}.png"), image)
    masks = tmp_path.parent / f"{tmp_path.name}-mask.png"
    cv2.imwrite(str(masks), image[..., 0])
    return tmp_path, masks


def test_a_mask_bends_as_the_images_do(folder):
    images, mask = folder
    source = open_source(images, InputConfig(intrinsics=LENS, long_edge=100, mask=mask)).straight()
    frame = next(iter(source))
    assert source.mask.shape == frame.image.shape[:2]
    assert 0.9 < source.mask.mean() < 1  # the part that it leaves, and a bent line
    assert (source.mask != (frame.image[..., 0] > 127)).mean() < 0.01
    columns = (~source.mask).argmax(0)
    assert np.ptp(columns) >= 2  # a line that the lens had bent


def test_without_a_mask_there_is_none_and_a_missing_one_is_told(folder):
    images, mask = folder
    assert open_source(images).mask is None
    with pytest.raises(InputError, match="missing or damaged"):
        open_source(images, InputConfig(mask=mask.with_name("none.png")))


def test_a_mask_may_be_smaller_but_not_of_another_shape(folder):
    images, mask = folder
    cv2.imwrite(str(mask), np.full((48, 64), 255, np.uint8))
    assert open_source(images, InputConfig(mask=mask)).mask.all()
    for height, width in ((128, 96), (48, 128), (95, 128 // 2)):
        cv2.imwrite(str(mask), np.full((height, width), 255, np.uint8))
        with pytest.raises(InputError, match=f"has {width}x{height} pixels, and the image 128x96"):
            open_source(images, InputConfig(mask=mask))
    masks = mask.with_suffix("")
    masks.mkdir()
    cv2.imwrite(str(masks / "1.png"), np.full((128, 96), 255, np.uint8))
    with pytest.raises(InputError, match="has 96x128 pixels"):
        list(open_source(images, InputConfig(mask=masks, readout=0.0)))


def test_masks_of_a_folder_are_found_by_name_and_paint_what_they_hide(folder):
    images, mask = folder
    masks = mask.with_suffix("")
    masks.mkdir()
    shown = np.full((96, 128), 255, np.uint8)
    for name, column in (("0.png", 30), ("2.png.png", 60)):
        picture = shown.copy()
        picture[:, :column] = 0
        cv2.imwrite(str(masks / name), picture)
    config = InputConfig(intrinsics="80,80,63.5,47.5", mask=masks, readout=0.0)
    source = open_source(images, config)
    assert source.mask is None
    assert source.black_is_masked
    hidden = [~frame.image.any(-1) for frame in source]
    assert [int(h.argmin(1)[0]) for h in hidden] == [30, 0, 60]
    assert [int(h.sum()) for h in hidden] == [30 * 96, 0, 60 * 96]  # not the black below the line
    assert not open_source(images, InputConfig(readout=0.0)).black_is_masked


def test_masks_of_a_video_are_found_by_the_number_of_the_frame(tmp_path):
    write_video(tmp_path / "v.mp4", [gradient_image(k) for k in range(4)])
    (tmp_path / "masks").mkdir()
    picture = np.full((48, 64), 255, np.uint8)
    picture[:, 40:] = 0
    cv2.imwrite(str(tmp_path / "masks/000002.png"), picture)
    config = InputConfig(
        intrinsics="50,50,31.5,23.5", mask=tmp_path / "masks", stride=2, readout=0.0
    )
    first, second = open_source(tmp_path / "v.mp4", config)
    assert first.image.any(-1).all()
    assert (~second.image.any(-1)).sum() == 24 * 48
    (tmp_path / "masks/000002.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="missing or damaged"):
        list(open_source(tmp_path / "v.mp4", config))
    (tmp_path / "masks/000002.png").unlink()
    with pytest.raises(InputError, match="holds no masks"):
        open_source(tmp_path / "v.mp4", config)
