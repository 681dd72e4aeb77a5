"""Decoding: what is damaged is known, and nobody's standard error gets noise, or loses a line."""

import os
import struct
import time
import zlib

import cv2
import numpy as np
import pytest

from geogs.errors import InputError
from geogs.io.decoder_noise import decoder_noise
from geogs.io.pictures import decoded, header_of
from io_samples import gradient_image, write_image


def png(width: int, height: int) -> bytes:
    """The head of a picture of any size, with nothing in it."""
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + head
    return (
        b"\x89PNG\r\n\x1a\n" + struct.pack(">I", len(head)) + chunk
        + struct.pack(">I", zlib.crc32(chunk)) + b"\0\0\0\0IEND\xaeB`\x82"
    )  # fmt: skip


def test_a_jpeg_with_a_hole_is_decoded_as_damaged_and_in_silence(tmp_path, capfd):
    path = write_image(tmp_path / "a.jpg", gradient_image(3, 320, 240))
    good = decoded(path, cv2.IMREAD_COLOR)
    assert not good.is_damaged
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 40] = bytes(40)
    path.write_bytes(data)
    found = decoded(path, cv2.IMREAD_COLOR)
    assert found.picture is not None
    assert found.picture.shape == (240, 320, 3)
    assert found.is_damaged
    assert not np.array_equal(found.picture, good.picture)
    assert capfd.readouterr().err == ""


def test_lines_of_others_reach_the_standard_error(capfd):
    with decoder_noise() as noise:
        os.write(2, b"Corrupt JPEG data: premature end\nsomebody else\n")
    assert noise == ["Corrupt JPEG data: premature end"]
    assert capfd.readouterr().err == "somebody else\n"


def test_noise_that_fills_a_pipe_is_not_waited_for():
    with decoder_noise() as noise:
        for _ in range(100):
            try:
                os.write(2, b"libpng warning: again\n" * 200)
            except BlockingIOError:
                break
    assert len(noise) > 100


def test_a_small_file_that_promises_a_large_picture_is_none(tmp_path):
    path = tmp_path / "a.png"
    for size in ((30_000, 30_000), (60_000, 60_000), (2**31 - 1, 2**31 - 1)):
        path.write_bytes(png(*size))
        begin = time.process_time()  # of this process, whatever else the machine does
        assert decoded(path, cv2.IMREAD_COLOR).picture is None
        assert time.process_time() - begin < 10


def test_more_pixels_than_are_read_are_told(tmp_path):
    (tmp_path / "a.png").write_bytes(png(20_000, 20_000))
    with pytest.raises(InputError, match="more than 178 megapixels"):
        header_of(tmp_path / "a.png")


def test_pipes_and_folders_are_no_pictures(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    for path in (tmp_path / "pipe.png", tmp_path, tmp_path / "none.png"):
        assert decoded(path, cv2.IMREAD_COLOR).picture is None
        assert header_of(path) is None
