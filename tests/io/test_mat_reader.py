"""MATLAB files: what SciPy writes is read as it reads it; damaged ones are refused."""

import struct
import zlib

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from geogs.errors import InputError
from geogs.io.mat_reader import read_mat

ARRAYS = {
    "mask": np.arange(24, dtype=np.uint8).reshape(2, 3, 4),
    "flag": np.array([[True, False, True]]),
    "box": np.array([[-5.0, 0.25, 1e300], [5, 5, -5]]),
    "small": np.array([[2.0]]),
    "wide": np.arange(6, dtype=np.int16).reshape(3, 2),
    "single": np.linspace(0, 1, 7, dtype=np.float32)[None],
    "empty": np.zeros((0, 3)),
}


@pytest.mark.parametrize("is_packed", [False, True])
def test_arrays_are_those_that_scipy_reads(tmp_path, is_packed):
    path = tmp_path / "a.mat"
    others = {"text": "words", "table": {"a": 1.0}, "cells": np.array([1, "b"], object)}
    savemat(path, {**others, **ARRAYS, "last": 1.5}, do_compression=is_packed)
    read, expected = read_mat(path, ARRAYS), loadmat(path)
    assert set(read) == set(ARRAYS)
    for name, array in read.items():
        assert array.dtype == expected[name].dtype
        np.testing.assert_array_equal(array, expected[name])


def test_numbers_that_are_stored_as_smaller_ones_keep_their_type(tmp_path):
    """As MATLAB does it with whole numbers; here in the other order of bytes."""
    flags = struct.pack(">IIII", 6, 8, 6, 0)
    shape = struct.pack(">IIii", 5, 8, 1, 2)
    name, values = struct.pack(">HH4s", 1, 1, b"x"), struct.pack(">HH4s", 2, 2, b"\x07\xff")
    array = flags + shape + name + values
    matrix = struct.pack(">II", 14, len(array)) + array
    packed = zlib.compress(matrix)
    head = b" " * 124 + struct.pack(">H", 0x0100) + b"MI"
    for data in (matrix, struct.pack(">II", 15, len(packed)) + packed):
        (tmp_path / "a.mat").write_bytes(head + data)
        (found,) = read_mat(tmp_path / "a.mat", {"x"}).values()
        assert found.dtype == np.float64
        assert found.tolist() == [[7.0, 255.0]]


@pytest.mark.parametrize("is_packed", [False, True])
def test_damaged_files_are_refused_in_a_sentence(tmp_path, is_packed):
    path, random = tmp_path / "a.mat", np.random.default_rng(0)
    savemat(path, ARRAYS, do_compression=is_packed)
    good, refused = path.read_bytes(), 0
    for _ in range(600):
        data = bytearray(good)
        for place in random.integers(0, len(data), random.integers(1, 6)):
            data[place] = random.integers(256)
        path.write_bytes(data[: random.integers(100, len(data) + 1)])
        try:
            read_mat(path, ARRAYS)
        except InputError:
            refused += 1
    assert refused > 150


def test_an_array_that_promises_more_than_the_file_holds_takes_no_memory(tmp_path):
    array = struct.pack("<IIII", 6, 8, 9, 0) + struct.pack("<IIii", 5, 8, 1 << 15, 1 << 15)
    array += struct.pack("<HH4s", 1, 1, b"x") + struct.pack("<II", 2, 1 << 30)
    for size in (len(array), 0xFFFFFFF0):
        packed = zlib.compress(struct.pack("<II", 14, size) + array)
        data = b" " * 124 + struct.pack("<H", 0x0100) + b"IM"
        data += struct.pack("<II", 15, len(packed)) + packed
        (tmp_path / "a.mat").write_bytes(data)
        with pytest.raises(InputError, match="damaged"):
            read_mat(tmp_path / "a.mat", {"x"})
