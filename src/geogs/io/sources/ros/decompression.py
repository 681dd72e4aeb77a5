"""Decompression of a bag's chunks, messages and files: no more is unpacked than a bound.

``rosbags`` unpacks whatever a file says; some kilobytes may become all of the memory or the disk.
"""

import bz2
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, BinaryIO, Literal

import lz4.frame
from rosbags.rosbag1 import reader as ros1
from rosbags.rosbag2 import reader as ros2
from rosbags.rosbag2 import storage_mcap

MOST = 1 << 28
"""Bytes of the largest chunk or message; an image of 8K with three times 16 bits has 200 MB."""
_FRAMES = 1000
"""Most frames of a part: that of a parallel bzip2 has one for every 900 kB."""
_zstd = ros2.zstd


class TooLarge(ValueError):
    """What a part unpacks to exceeds a bound."""


def bounded(new: Callable[[], Any]) -> Callable[..., bytes]:
    """Return a function that unpacks data, each of its frames by a new decompressor.

    It raises TooLarge where there are, or are said to be, more than ``MOST`` bytes, or too many
    frames.
    """

    def decompress(data: bytes, size: int = 0) -> bytes:
        parts = list[bytes]()
        left = MOST if size <= MOST else -1
        while data and left >= 0:
            if len(parts) == _FRAMES:
                raise TooLarge(f"a part of it has more than {_FRAMES} compressed frames")
            frame = new()
            parts.append(frame.decompress(data, max_length=left + 1))
            left -= len(parts[-1])
            if left >= 0 and not frame.eof:
                raise ValueError("the compressed data are cut off")
            data = frame.unused_data
        if left < 0:
            raise TooLarge(f"a part of it unpacks to more than {MOST >> 20} MB")
        return b"".join(parts)

    return decompress


@contextmanager
def _opened(file: BinaryIO, mode: Literal["rb"]) -> Iterator[Any]:
    """Open a compressed file, of which no more is read than half of what the disk has left."""
    left = shutil.disk_usage(tempfile.gettempdir()).free // 2
    with _zstd.open(file, mode) as inner:

        def read(count: int) -> bytes:
            nonlocal left
            data: bytes = inner.read(count)
            left -= len(data)
            if left < 0:
                raise TooLarge("a file of it unpacks to more than half of the free disk")
            return data

        yield SimpleNamespace(read=read)


def bound_decompression() -> None:
    """Make ``rosbags`` unpack within bounds, in all bags that this process reads."""
    by_zstd = bounded(_zstd.ZstdDecompressor)
    by_lz4 = bounded(lz4.frame.LZ4FrameDecompressor)
    storage_mcap.DECOMPRESSORS |= {"zstd": by_zstd, "lz4": by_lz4}
    ros1.decompressors |= {"bz2": bounded(bz2.BZ2Decompressor), "lz4": by_lz4}
    vars(ros2)["zstd"] = SimpleNamespace(decompress=by_zstd, open=_opened)
