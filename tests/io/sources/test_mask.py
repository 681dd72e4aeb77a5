"""The mask of a source, straightened as its images are."""

import cv2
import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.sniff import open_source

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
    source = open_source(images, InputConfig(intrinsics=LENS, long_edge=100, mask=mask))
    frame = next(iter(source))
    assert source.mask.shape == frame.image.shape[:2]
    assert 0.6 < source.mask.mean() < 0.9
    assert (source.mask != (frame.image[..., 0] > 127)).mean() < 0.01
    columns = (~source.mask).argmax(0)
    assert np.ptp(columns) >= 2  # a line that the lens had bent


def test_without_a_mask_there_is_none_and_a_missing_one_is_told(folder):
    images, mask = folder
    assert open_source(images).mask is None
    with pytest.raises(InputError, match="missing or damaged"):
        open_source(images, InputConfig(mask=mask.with_name("none.png")))
