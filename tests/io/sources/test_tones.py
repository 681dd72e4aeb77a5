"""Pictures of 10, 12, 14 and 16 bits, of a narrow range, and of floating point."""

import cv2
import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.io.sources.posed.one_camera import OneCamera
from geogs.io.sources.posed.posed_set import PosedFile
from geogs.io.sources.sniff import open_source
from geogs.io.sources.tones import tones_of
from io_samples import gradient_image

NATIVE = InputConfig(intrinsics="50,50,31.5,23.5", long_edge=0)


def grey(index: int) -> np.ndarray:
    """Values 0 to 255 in 8 bits, another image for each index."""
    image = gradient_image(index)
    return (image[..., 1] // 2 + image[..., 2] // 2 + index % 3).astype(np.uint8)


def write(folder, ending, values, count=5) -> list:
    """Pictures whose stored values are a function of those in 8 bits."""
    paths = [folder / f"{i:03d}.{ending}" for i in range(count)]
    for i, path in enumerate(paths):
        assert cv2.imwrite(str(path), values(grey(i)))
    return paths


@pytest.mark.parametrize("ending", ["png", "tif", "pgm"])
@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_bits_in_use_become_the_upper_ones(tmp_path, ending, bits):
    """As the pictures of 8 bits, to a level."""
    step = 1 << (bits - 8)
    paths = write(tmp_path, ending, lambda g: g.astype(np.uint16) * step + step // 3)
    source = open_source(tmp_path, NATIVE)
    for i, frame in enumerate(source):
        np.testing.assert_array_equal(frame.image, np.repeat(grey(i)[..., None], 3, axis=2))
    said = [line for line in source.account.used if "bits" in line]
    assert said == ([] if bits == 16 else [f"pictures use {bits} of their 16 bits"])
    posed = OneCamera([PosedFile(path, np.eye(4)) for path in paths], NATIVE)
    np.testing.assert_array_equal(posed.read(1)[0][..., 0], grey(1))
    assert set(said) <= set(posed.account.used)


def test_colour_keeps_its_order(tmp_path):
    for i in range(3):
        deep = gradient_image(i)[..., ::-1].astype(np.uint16) * 16
        cv2.imwrite(str(tmp_path / f"{i}.png"), deep)
    image = next(iter(open_source(tmp_path, NATIVE))).image
    np.testing.assert_array_equal(image, gradient_image(0))


@pytest.mark.parametrize(
    ("ending", "values"),
    [
        ("tif", lambda g: 7300 + 2 * g.astype(np.uint16)),
        ("png", lambda g: 21000 + 4 * g.astype(np.uint16)),
        ("tif", lambda g: np.float32(285) + g.astype(np.float32) / 40),
        ("tif", lambda g: (g.astype(np.float32) - 100) * 1e-3),
    ],
)
def test_a_narrow_range_is_stretched_alike_in_all_images(tmp_path, ending, values):
    write(tmp_path, ending, values)
    source = open_source(tmp_path, NATIVE)
    images = [frame.image[..., 0].astype(float) for frame in source]
    assert images[0].max() - images[0].min() > 180
    for i, image in enumerate(images):
        slope, offset = np.polyfit(grey(i).ravel(), image.ravel(), 1)
        assert np.abs(slope * grey(i) + offset - image).max() < 4
        assert slope == pytest.approx(
            np.polyfit(grey(0).ravel(), images[0].ravel(), 1)[0], rel=0.01
        )
    assert any("become black and white" in line for line in source.account.used)


def test_eight_bits_and_a_dark_picture_stay_as_they_are():
    dark = np.full((40, 40), 30, np.uint8)
    assert tones_of([dark])(dark) is dark
    deep = np.tile(np.linspace(0, 65535, 400).astype(np.uint16), (40, 1))
    np.testing.assert_array_equal(tones_of([deep])(deep), deep >> 8)
    flat = np.full((40, 40), 5000, np.uint16)
    assert tones_of([flat])(flat).std() == 0
    unknown = np.full((8, 8), np.nan, np.float32)
    assert tones_of([unknown])(unknown).max() == 0
