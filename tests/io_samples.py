"""Small sequences written to disk for the tests of input and output."""

import struct
import zlib
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

TIME_BASE = Fraction(1, 1000)


def gradient_image(index: int, width: int = 64, height: int = 48) -> np.ndarray:
    """RGB image whose red tells the frame, green the column and blue the row."""
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[..., 0] = 10 * index % 250
    image[..., 1] = np.linspace(0, 255, width).astype(np.uint8)[None]
    image[..., 2] = np.linspace(0, 255, height).astype(np.uint8)[:, None]
    return image


def write_image(path: Path, image: np.ndarray) -> Path:
    """Write an RGB image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1])
    return path


def write_images(folder: Path, names: Sequence[str], width: int = 64, height: int = 48) -> Path:
    """Write ``gradient_image`` 0, 1, 2, ... under the given names."""
    for index, name in enumerate(names):
        write_image(folder / name, gradient_image(index, width, height))
    return folder


def write_video(
    path: Path,
    images: Sequence[np.ndarray],
    milliseconds: Sequence[int] | None = None,
    rotation: int = 0,
    codec: str = "libx264",
    gop: int = 4,
    title: str = "",
    index_first: bool = False,
    aspect: Fraction | None = None,
) -> Path:
    """Write a video with the given presentation times (33 ms steps if none).

    ``rotation`` is the counter-clockwise angle of the display matrix in degrees, ``aspect`` the
    width of a pixel by its height.
    """
    height, width = images[0].shape[:2]
    times = milliseconds or [33 * i for i in range(len(images))]
    options = {"movflags": "faststart"} if index_first else {}
    with av.open(str(path), "w", options=options) as container:
        container.metadata["title"] = title
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.time_base = TIME_BASE
        stream.codec_context.gop_size = gop
        stream.codec_context.bit_rate = 2_000_000
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        if rotation:
            stream.set_display_rotation(rotation)
        for image, time in zip(images, times, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = time, TIME_BASE
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def empty_png(width: int, height: int) -> bytes:
    """The head of a picture of any size, with nothing in it."""
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + head
    return (
        b"\x89PNG\r\n\x1a\n" + struct.pack(">I", len(head)) + chunk
        + struct.pack(">I", zlib.crc32(chunk)) + b"\0\0\0\0IEND\xaeB`\x82"
    )  # fmt: skip
