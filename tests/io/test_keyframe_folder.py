"""Rows of keyframes in the folder of a result."""

import pytest
import torch

from geogs.errors import InputError
from geogs.io.writers.keyframe_folder import read_rows, rows_path, write_rows
from geogs.types import SeenRows


def seen(seed: int, height: int = 4) -> SeenRows:
    random = torch.Generator().manual_seed(seed)
    offset = torch.randn(height, 5, 2, generator=random)
    return SeenRows(offset.half(), torch.randn(height, 5, generator=random).half(), 0.1 * seed)


def test_what_is_written_is_read(tmp_path):
    path = rows_path(tmp_path)
    assert read_rows(path) == {}
    write_rows(path, {7: seen(0), 12: seen(1)})
    found = read_rows(path)
    assert list(found) == [7, 12]
    for k, rows in enumerate(found.values()):
        assert torch.equal(rows.offset, seen(k).offset)
        assert torch.equal(rows.seconds, seen(k).seconds)
        assert rows.doubt == 0.1 * k


def test_a_damaged_file_is_one_sentence(tmp_path):
    path = rows_path(tmp_path)
    write_rows(path, {7: seen(0)})
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(InputError, match=r"rows.safetensors is damaged; delete it"):
        read_rows(path)
    holed = seen(0)
    holed.offset[0, 0, 0] = torch.nan
    write_rows(path, {7: holed})
    with pytest.raises(InputError, match=r"is damaged"):
        read_rows(path)
