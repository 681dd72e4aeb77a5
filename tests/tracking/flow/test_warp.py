"""A grey image at other places, against cubic convolution written out."""

import numpy as np
import pytest

from geogs.tracking.flow.flow_kernels import warp


def warped(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    out = np.empty(x.shape, np.uint8)
    warp(image, x.astype(np.float32), y.astype(np.float32), out)
    return out


def keys(distance: float) -> float:
    """Keys' kernel, a = -1/2."""
    s = abs(distance)
    if s <= 1:
        return 1.5 * s**3 - 2.5 * s**2 + 1
    return -0.5 * (s**3 - 5 * s**2 + 8 * s - 4) if s < 2 else 0.0


def shown(image: np.ndarray, x: float, y: float) -> float:
    rows, columns = (np.arange(int(np.floor(p)) - 1, int(np.floor(p)) + 3) for p in (y, x))
    down, across = (np.array([keys(p - n) for n in of]) for p, of in ((y, rows), (x, columns)))
    bottom, right = image.shape[0] - 1, image.shape[1] - 1
    around = image[np.clip(rows, 0, bottom)[:, None], np.clip(columns, 0, right)]
    return float(np.clip(down @ around @ across, 0, 255))


def test_it_is_cubic_convolution_within_the_image_and_beside_it():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (20, 30), np.uint8)
    x, y = rng.uniform(-4, 34, (40, 12)), rng.uniform(-4, 24, (40, 12))
    x, y = x.astype(np.float32), y.astype(np.float32)
    near = np.clip(x, -2, 31), np.clip(y, -2, 21)
    want = [shown(image, u, v) for u, v in zip(*(p.ravel() for p in near), strict=True)]
    off = warped(image, x, y).ravel() - np.array(want)
    assert np.abs(off).max() < 0.51
    whole = np.mgrid[:20, :30]
    np.testing.assert_array_equal(warped(image, whole[1], whole[0]), image)


def test_what_is_far_or_no_number_is_at_the_border():
    image = np.random.default_rng(1).integers(0, 256, (12, 16), np.uint8)
    far = np.array([[-1e4, 1e4, np.nan, 1e9, -np.inf]])
    found = warped(image, far, np.full_like(far, 3))[0].tolist()
    left, right = image[3, 0], image[3, -1]
    assert found == [left, right, left, right, left]


@pytest.mark.parametrize("fraction", [0.1, 0.25, 0.4, 0.6])
def test_things_stay_at_their_place(fraction):
    """Waves of ten pixels are shown less than a hundredth of a pixel or so beside it."""
    y, x = np.mgrid[:16, :200].astype(float)
    image = np.rint(128 + 100 * np.sin(2 * np.pi * x / 10)).astype(np.uint8)
    inner = np.s_[4:-4, 10:-10]
    found = warped(image, x + fraction, y)[inner] - 128.0
    phase = np.angle((found * np.exp(-2j * np.pi * x[inner] / 10)).mean() * 1j)
    assert phase * 10 / (2 * np.pi) == pytest.approx(fraction, abs=0.012)
