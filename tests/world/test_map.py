"""The map's table: packed, made again, and what does not fit is said."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.world.disks import DiskParameters
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from geogs.world.map import DepthSearch, MapTable, RandomState, SearchedDepth, ViewRow, check_map
from records import copied

SIZE = (6, 8)


def keyframes(count: int) -> KeyframeTable:
    table = KeyframeTable.on(SampleGrid(Camera(60.0, 60.0, 31.5, 23.5, 64, 48)))
    known, image = table.new_set(), np.zeros((48, 64, 3), np.uint8)
    for n in range(count):
        known.add(n, n / 30, image, None, torch.eye(4, dtype=torch.float64))
    return table


def filled() -> MapTable:
    """Two views, one with a depth, and a few disks that have been trained."""
    table, random = MapTable.empty("cpu", seed=3), torch.Generator().manual_seed(0)
    sizes = (5, 3), (5, 4), (5, 2), (5,)
    table.disks.append(DiskParameters(*(torch.randn(s, generator=random) for s in sizes)), 1)
    table.disks.second.position.fill_(0.5)
    search = DepthSearch(1.0, 2.0, 3.0)
    table.views = {0: ViewRow(), 1: ViewRow([0], search, torch.ones(3), SearchedDepth(2.0, 1.0))}
    for name, value in (("depth", 2.0), ("confidence", 0.5)):
        table.arrays.put(name, 1, np.full(SIZE, value, np.float32))
    table.mapped, table.resident, table.unit, table.order = [1], [1], 2.0, [0]
    return table


def test_it_comes_back_with_its_random_numbers():
    table = filled()
    table.random.of_numpy.random(7)
    torch.rand(3, generator=table.random.of_torch)
    table.random.settle()
    again = copied(table)
    check_map(again, keyframes(2), SIZE)
    for own, other in zip(table.disks.parameters, again.disks.parameters, strict=True):
        assert torch.equal(own, other)
        assert other.requires_grad
    assert torch.equal(again.disks.second.position, table.disks.second.position)
    assert again.views[1].search == table.views[1].search
    assert again.arrays.load("depth", 1).tolist() == table.arrays.load("depth", 1).tolist()
    assert again.random.of_numpy.random() == table.random.of_numpy.random()
    words = (torch.rand(2, generator=t.random.of_torch) for t in (table, again))
    assert torch.equal(*words)


def test_what_does_not_fit_is_said():
    known = keyframes(2)
    for change, sentence in (
        ({"mapped": [7]}, "mapped.0 names what is missing in the keyframes"),
        ({"order": [1]}, "the place in the training is none"),
        (
            {"views": {**filled().views, 5: ViewRow()}},
            "views names what is missing in the keyframes",
        ),
        (
            {"views": {**filled().views, 0: ViewRow(depth=SearchedDepth(1.0, 1.0))}},
            "the depth of keyframe 0 is missing",
        ),
    ):
        with pytest.raises(InputError, match=sentence):
            check_map(replace(filled(), **change), known, SIZE)
    with pytest.raises(InputError, match="the 'depth' of keyframe 1 cannot be"):
        check_map(filled(), known, (8, 6))
    state = filled().random
    with pytest.raises(InputError, match="in no state that there is"):
        RandomState(-1, state.increment, 0, 0, state.words)
    disks = filled().disks
    few = disks.steps[:3]
    with pytest.raises(ValueError, match="the disks are incomplete"):
        replace(disks, keyframe_id=few, steps=few, seen=few)
