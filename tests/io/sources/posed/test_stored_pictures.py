"""Pictures read at a part of their size: the same view, without a shift."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from geogs.errors import InputError
from geogs.io.sources.posed.stored_pictures import read_picture, reduction


def picture(width: int, height: int) -> np.ndarray:
    """Blobs of several sizes."""
    rng = np.random.default_rng(0)
    noise = rng.uniform(0, 1, (height, width, 3)).astype(np.float32)
    blobs = sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (4.0, 10.0, 30.0))
    low, high = np.percentile(blobs, [1, 99])
    return np.clip(255 * (blobs - low) / (high - low), 0, 255).astype(np.uint8)


def written(path: Path, image: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 97])
    return path


@pytest.mark.parametrize(("needed", "parts"), [((320, 240), 2), ((160, 120), 4), ((80, 60), 8)])
def test_a_reduced_picture_is_the_mean_of_its_blocks_without_a_shift(tmp_path, needed, parts):
    image = picture(640, 480)
    read = read_picture(written(tmp_path / "a.jpg", image), (640, 480), needed)
    assert read.shape == (480 // parts, 640 // parts, 3)
    mean = cv2.resize(image, read.shape[1::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(read.astype(int) - mean).mean() < 1.5
    grey = [cv2.cvtColor(i, cv2.COLOR_RGB2GRAY).astype(np.float32) for i in (mean, read)]
    shift, _ = cv2.phaseCorrelate(*grey, cv2.createHanningWindow(grey[0].shape[::-1], cv2.CV_32F))
    assert np.abs(shift).max() < 0.05


def test_a_picture_is_read_whole_where_a_part_would_not_do(tmp_path):
    path = written(tmp_path / "a.jpg", picture(640, 480))
    assert read_picture(path, (640, 480), (321, 240)).shape == (480, 640, 3)
    assert read_picture(path).shape == (480, 640, 3)
    odd = written(tmp_path / "b.jpg", picture(642, 481))
    assert read_picture(odd, (642, 481), (100, 75)).shape == (481, 642, 3)
    lossless = tmp_path / "c.png"
    cv2.imwrite(str(lossless), picture(640, 480))
    assert read_picture(lossless, (640, 480), (160, 120)).shape == (480, 640, 3)


def test_parts_divide_both_sides():
    assert reduction((3840, 2160), (800, 450)) == 4
    assert reduction((4000, 3000), (500, 375)) == 8
    assert reduction((4000, 3002), (500, 375)) == 2
    assert reduction((640, 480), (640, 480)) == 1


def test_a_picture_of_another_size_is_refused(tmp_path):
    path = written(tmp_path / "a.jpg", picture(640, 480))
    with pytest.raises(InputError, match="damaged"):
        read_picture(path, (1280, 960), (320, 240))
