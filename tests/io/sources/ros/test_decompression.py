"""Compressed bags: what they hold is read, and no more is unpacked than a bound."""

import bz2

import lz4.frame
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from bag_samples import BagWriter
from geogs.errors import InputError
from geogs.io.sources.ros import decompression
from geogs.io.sources.ros.bag import Bag
from geogs.io.sources.ros.decompression import TooLarge, _zstd, bounded

COMPRESSORS = {
    "zstd": (_zstd.compress, _zstd.ZstdDecompressor),
    "lz4": (lz4.frame.compress, lz4.frame.LZ4FrameDecompressor),
    "bz2": (bz2.compress, bz2.BZ2Decompressor),
}
WAYS = ["bag bz2", "bag lz4", "mcap storage", "sqlite message", "sqlite file", "mcap message"]


@pytest.mark.parametrize("name", COMPRESSORS)
def test_frames_are_unpacked_one_after_the_other_up_to_a_bound(name, monkeypatch):
    compress, new = COMPRESSORS[name]
    monkeypatch.setattr(decompression, "MOST", 5000)
    unpack = bounded(new)
    first, second = bytes(3000), np.random.default_rng(0).bytes(2000)
    assert unpack(compress(first) + compress(second), 5000) == first + second
    for data, said in [(bytes(5001), 0), (bytes(10_000_000), 0), (b"a", 5001)]:
        with pytest.raises(TooLarge, match="unpacks to more than"):
            unpack(compress(data), said)
    with pytest.raises(TooLarge, match="unpacks to more than"):
        unpack(compress(first) + compress(first))
    with pytest.raises(TooLarge, match="more than 1000"):
        unpack(20_000 * compress(b""))
    with pytest.raises(ValueError, match="cut off"):
        unpack(compress(second)[:-4])


def written(folder, way: str):
    """A bag of five images of 64 x 48, 9216 bytes each, compressed in some way."""
    kind, mode = way.split()
    writer = BagWriter(folder, kind)
    if kind == "bag":
        writer._writer.set_compression(Writer1.CompressionFormat[mode.upper()])
    else:
        writer._writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    with writer as bag:
        for k in range(5):
            bag.image("/camera", k, np.full((48, 64, 3), 40 * k, np.uint8))
    return writer.path


@pytest.mark.parametrize("way", WAYS)
def test_a_compressed_bag_is_read_and_one_that_becomes_too_large_is_not(tmp_path, way, monkeypatch):
    path = written(tmp_path, way)
    images = [frame.image for frame in Bag(path).read(0, None, 1)]
    assert [int(image[0, 0, 0]) for image in images] == [0, 40, 80, 120, 160]
    monkeypatch.setattr(decompression, "MOST", 9000)
    monkeypatch.setattr(decompression.shutil, "disk_usage", lambda _: _Disk)
    with pytest.raises(InputError, match=f"{path.name}: .* unpacks to more than"):
        list(Bag(path).read(0, None, 1))


class _Disk:
    free = 20_000
