"""Arrays of old keyframes leave the memory and come back as they were."""

import errno
import gc
import os

import numpy as np
import pytest
import torch

from geogs.application.checkpoints.folder import CheckpointFolder
from geogs.errors import OutputError
from geogs.geometry.camera import Camera
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.world.archive import Archive
from geogs.world.arrays import ArrayTable
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable

CAMERA = Camera(90.0, 90.0, 63.5, 47.5, 128, 96)


def resident_bytes() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_arrays_of_any_type_come_back(tmp_path):
    rng = np.random.default_rng(0)
    arrays = [
        rng.integers(0, 255, (5, 7, 3), dtype=np.uint8),
        rng.standard_normal((4, 3)).astype(np.float16),
        rng.standard_normal((9, 8)).T,
        np.array(3.5, np.float32),
        np.zeros((0, 3), np.float32),
    ]
    archive = Archive(tmp_path)
    archived = [archive.put(a) for a in arrays]
    for handle, array in [*zip(archived, arrays, strict=True)] * 2:
        loaded = handle.load()
        assert loaded.dtype == array.dtype
        np.testing.assert_array_equal(loaded, array)
    assert list(tmp_path.iterdir()) == []  # the file has no name


def test_recent_arrays_are_not_read_again():
    table = ArrayTable(resident=2)
    arrays = [np.full(4, n) for n in range(3)]
    for n, array in enumerate(arrays):
        table.put("image", n, array, recent=True)

    def image(n: int) -> np.ndarray:
        return table.get("image", n, recent=True)

    assert image(2) is arrays[2]
    assert image(1) is arrays[1]
    assert image(0) is not arrays[0]
    assert image(0) is image(0)
    assert image(2) is not arrays[2]
    table.forget(2)
    assert image(2) is None


def test_space_of_forgotten_arrays_is_used_again():
    archive = Archive()
    kept = archive.put(np.arange(100))
    for n in range(10):
        gone = archive.put(np.full(100, n))
        del gone
        gc.collect()
    assert archive._end == 2 * kept.load().nbytes
    np.testing.assert_array_equal(kept.load(), np.arange(100))


def test_a_large_archive_takes_no_memory():
    archive, block = Archive(), np.ones((1 << 20,), np.float64)
    handles = [archive.put(block + n) for n in range(2)]
    before = resident_bytes()
    handles += [archive.put(block + n) for n in range(2, 40)]
    assert resident_bytes() - before < 24 << 20  # of 304 MiB
    assert handles[30].load()[5] == 31


def test_a_full_disk_is_one_sentence(monkeypatch, tmp_path):
    archive = Archive(tmp_path)

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(OutputError, match=r"No space left on device\); free some space"):
        archive.put(np.zeros(3))


def test_a_missing_folder_is_one_sentence(tmp_path):
    with pytest.raises(OutputError, match="cannot be kept in"):
        Archive(tmp_path / "gone")


def test_old_keyframes_are_read_and_encoded_again():
    grid = SampleGrid(CAMERA)
    operator, rng = ClassicalFlow(grid), np.random.default_rng(1)
    store = KeyframeTable.on(grid, operator.encode, resident=3).new_set()
    images = [rng.integers(0, 255, (96, 128, 3), dtype=np.uint8) for _ in range(8)]
    encoded = [operator.encode(image) for image in images]
    for n, image in enumerate(images):
        state = store.add(n, n / 30, image, encoded[n], torch.eye(4, dtype=torch.float64))
        state.prior_normal = torch.full((96, 128, 3), float(n)).half()
    assert store[7].image is images[7]
    assert store[7].encoded is encoded[7]
    for n, state in enumerate(store):
        np.testing.assert_array_equal(state.image, images[n])
        again = state.encoded
        for name in ("grey", "half"):
            np.testing.assert_array_equal(getattr(again, name), getattr(encoded[n], name))
        assert state.prior_normal.dtype == torch.float16
        assert float(state.prior_normal.min()) == float(state.prior_normal.max()) == n
    assert store[0].image is not images[0]
    assert store[7].encoded is store[7].encoded


def test_keyframes_do_not_hold_their_images():
    grid = SampleGrid(CAMERA)
    store = KeyframeTable.on(grid, lambda image: None, resident=2).new_set()
    image = np.zeros((96, 128, 3), np.uint8)
    before = resident_bytes()
    for n in range(600):  # 21 MiB of images
        store.add(n, n / 30, image + np.uint8(n % 250), None, torch.eye(4, dtype=torch.float64))
        store[n].inverse_depth = store[n].information = torch.zeros(grid.size)
        store[n].image[0, 0, 0]  # having been looked at changes nothing
    assert resident_bytes() - before < 8 << 20
    assert store[3].image[5, 5, 1] == 3


def test_archives_keep_what_the_last_checkpoint_refers_to(tmp_path):
    archive = Archive()
    first, kept = (archive.put(np.full(100, n)) for n in range(2))
    settled = archive.settle(CheckpointFolder(tmp_path))
    archive.release()
    places = (first.offset, first.checksum), (kept.offset, kept.checksum)
    del first
    later = [archive.put(np.full(100, 7 + n)) for n in range(3)]
    again = Archive.reopened(CheckpointFolder(tmp_path), archive.name, settled)  # as after a kill
    shape, dtype = (100,), np.dtype(np.int64)
    for n, (offset, checksum) in enumerate(places):
        assert (again.piece(offset, shape, dtype, checksum).load() == n).all()
    assert again._end == 2 * 800
    del again
    # A complete checkpoint that knows nothing of the first array lets its space go.
    for _ in range(2):
        settled = archive.settle(CheckpointFolder(tmp_path))
        archive.release()
    size = archive._end
    later.append(archive.put(np.full(100, 3)))
    assert archive._end <= size + 800
    assert len(list(tmp_path.iterdir())) == 1


def test_an_archive_that_finds_no_room_stays_where_it_was(tmp_path, monkeypatch):
    archive = Archive(tmp_path)
    handle = archive.put(np.arange(1000))
    write = os.pwrite

    def full(descriptor: int, data: bytes, offset: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", full)
    place = tmp_path / "checkpoint"
    place.mkdir()
    with pytest.raises(OutputError, match=f"{place} .No space left.*larger disk for the results"):
        archive.settle(CheckpointFolder(place))
    monkeypatch.setattr(os, "pwrite", write)
    assert list(place.iterdir()) == []
    assert (handle.load() == np.arange(1000)).all()
