"""Decoding: what is damaged is known, and nobody's standard error gets noise, or loses a line."""

import os
import time

import cv2
import numpy as np
import pytest
from PIL import Image

from geogs.errors import InputError
from geogs.guard.decoder_noise import decoder_noise
from geogs.io.pictures import DEEP, decoded, decoded_bytes, header_of
from io_samples import empty_png, gradient_image, write_image


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
        path.write_bytes(empty_png(*size))
        begin = time.process_time()  # of this process, whatever else the machine does
        assert decoded(path, cv2.IMREAD_COLOR).picture is None
        assert time.process_time() - begin < 10


def test_a_part_of_a_png_that_is_longer_than_the_file_gets_no_memory(tmp_path, monkeypatch):
    path = write_image(tmp_path / "a.png", gradient_image(0))
    good = path.read_bytes()
    assert decoded(path, cv2.IMREAD_COLOR).picture is not None
    path.write_bytes(good[:33] + b"\xa0" + good[34:])  # the length of what follows the header
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it is decoded"))
    assert decoded(path, cv2.IMREAD_COLOR).picture is None


def test_more_pixels_than_are_read_are_told(tmp_path, capfd):
    (tmp_path / "a.png").write_bytes(empty_png(20_000, 20_000))
    with pytest.raises(InputError, match="more than 178 megapixels"):
        header_of(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(empty_png(12_000, 12_000))  # of which Pillow only warns
    assert header_of(tmp_path / "a.png") == ((12_000, 12_000), "RGB")
    assert capfd.readouterr() == ("", "")


def test_pipes_and_folders_are_no_pictures(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    for path in (tmp_path / "pipe.png", tmp_path, tmp_path / "none.png"):
        assert decoded(path, cv2.IMREAD_COLOR).picture is None
        assert header_of(path) is None


def test_a_tiff_that_is_turned_and_cut_off_is_no_error(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (60, 40)).save(tmp_path / "a.tif", exif=exif)
    data = np.fromfile(tmp_path / "a.tif", np.uint8)
    for flags, shape in ((DEEP, (60, 40)), (DEEP | cv2.IMREAD_IGNORE_ORIENTATION, (40, 60))):
        assert decoded_bytes(data, flags).picture.shape[:2] == shape
        assert all(decoded_bytes(data[:n], flags).picture is None for n in range(0, 150, 3))
