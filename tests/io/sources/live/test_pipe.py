"""Raw frames from a pipe."""

import io

import cv2
import numpy as np
import pytest

from geogs.errors import InputError
from geogs.io.sources.live.pipe import Pipe, format_from_words


def pictures(count=3, height=12, width=16):
    random = np.random.default_rng(0)
    small = random.integers(40, 200, (count, 3, 4, 3), np.uint8)
    return [cv2.resize(p, (width, height), interpolation=cv2.INTER_CUBIC) for p in small]


def test_bare_pixels_come_as_they_are_and_are_timed_by_their_number():
    images = pictures()
    data = b"".join(image.tobytes() for image in images)
    pipe = Pipe(io.BytesIO(data + b"cut off"), "16x12:rgb24@25")
    info = pipe.info
    assert (info.width, info.height, info.fps) == (16, 12, 25.0)
    frames = list(pipe.frames())
    assert [f.timestamp for f in frames] == pytest.approx([0, 0.04, 0.08])
    for frame, image in zip(frames, images, strict=True):
        assert np.array_equal(frame.image, image)
        assert frame.image.flags.writeable


def test_blue_first_and_grey():
    (image,) = pictures(1)
    (frame,) = Pipe(io.BytesIO(image[..., ::-1].tobytes()), "16x12:bgr24").frames()
    assert np.array_equal(frame.image, image)
    (frame,) = Pipe(io.BytesIO(image[..., 1].tobytes()), "16x12:gray").frames()
    assert np.array_equal(frame.image, np.repeat(image[..., 1:2], 3, 2))


@pytest.mark.parametrize(("chroma", "tolerance"), [("420jpeg", 24), ("444", 3)])
def test_yuv4mpeg2_says_its_own_format(chroma, tolerance):
    images = pictures(2)
    stream = io.BytesIO()
    stream.write(f"YUV4MPEG2 W16 H12 F30000:1001 Ip A1:1 C{chroma}\n".encode())
    for image in images:
        # ITU-R BT.601, written out: Y from 16 to 235, Cb and Cr from 16 to 240.
        r, g, b = np.moveaxis(image.astype(float), -1, 0)
        y = 0.299 * r + 0.587 * g + 0.114 * b
        planes = [16 + y * 219 / 255, 128 + 224 * (b - y) / 1.772 / 255,
                  128 + 224 * (r - y) / 1.402 / 255]  # fmt: skip
        if chroma != "444":
            planes[1:] = [p.reshape(6, 2, 8, 2).mean((1, 3)) for p in planes[1:]]
        stream.write(b"FRAME\n")
        for plane in planes:
            stream.write(np.rint(plane).astype(np.uint8).tobytes())
    stream.seek(0)
    pipe = Pipe(stream)
    frames = list(pipe.frames())
    assert (pipe.info.width, pipe.info.height) == (16, 12)
    assert pipe.info.fps == pytest.approx(29.97, abs=0.001)
    assert frames[1].timestamp == pytest.approx(1001 / 30000)
    for frame, image in zip(frames, images, strict=True):
        error = np.abs(frame.image.astype(int) - image)
        assert np.quantile(error, 0.95) <= tolerance
        assert error.mean() < 8


@pytest.mark.parametrize(
    "words", ["", "640x480", "640x480:rgb", "0x0:rgb24", "9x9:rgb24@0", "auto"]
)
def test_a_wrong_format_ends_in_a_sentence(words):
    with pytest.raises(InputError, match="pipe"):
        format_from_words(words)


@pytest.mark.parametrize(
    "data",
    [b"", b"P6 16 12 255\n", b"YUV4MPEG2 W16\n", b"YUV4MPEG2 Wx Hy\n",
     b"YUV4MPEG2 W16 H12 C410\n", b"YUV4MPEG2 W99999 H99999\n", b"YUV4MPEG2 W-16 H-12\n",
     *(b"YUV4MPEG2 W16 H12 F%s\n" % rate for rate in (
         b"1e999999999", b"1e999999999:1", b"1:1e999999999", b"9" * 400 + b":1", b"-30:1", b"30",
         b"999999999:1", b"1:999999999"))],
)  # fmt: skip
def test_a_wrong_header_ends_in_a_sentence(data):
    with pytest.raises(InputError, match="pipe"):
        Pipe(io.BytesIO(data))
