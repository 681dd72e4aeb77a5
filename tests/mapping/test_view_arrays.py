"""What the pool keeps of a view."""

from dataclasses import replace

import numpy as np
import torch

from geogs.config import Config, LossConfig
from geogs.depth.depth_view import DenseDepth
from geogs.geometry.camera import Camera
from geogs.mapping import view_arrays
from geogs.mapping.keyframe_views import KeyframeViews
from geogs.mapping.view_arrays import MapCameras, get_depth
from geogs.world.arrays import ArrayTable
from geogs.world.cell_depths import MeasuredCells
from geogs.world.keyframes import KeyframeSet
from geogs.world.map import ViewRow
from keyframe_samples import Sample, segment_of, views_of

CAMERA = Camera(fx=60.0, fy=60.0, cx=39.5, cy=31.5, width=80, height=64)
CONFIG = replace(Config().mapping, render_long_edge=40)
ONE = torch.ones(32, 40)


def black(
    count: int, loss: LossConfig = CONFIG.loss, resident: int = 128
) -> tuple[KeyframeSet, KeyframeViews]:
    """Black keyframes, and views that know none of them yet."""
    image, eye = np.zeros((64, 80, 3), np.uint8), torch.eye(4, dtype=torch.float64)
    segment = segment_of([Sample(n, image, eye) for n in range(count)], CAMERA, resident=resident)
    return segment, views_of(segment.table, MapCameras.of(CAMERA, CONFIG), loss)


def test_depth_of_what_moves_is_not_believed():
    segment, pool = black(1)
    pool.add(0)
    moving = torch.zeros(8, 10, dtype=torch.bool)
    moving[2:5, 3:7] = True
    segment[0].moving = moving.reshape(-1)
    pool[0].set_depth(DenseDepth(2 * ONE, 0.9 * ONE, torch.tensor(2.0)))
    found = pool[0].dense
    expected = torch.full((32, 40), 0.9)
    expected[8:20, 12:28] = 0
    torch.testing.assert_close(found.confidence, expected)
    torch.testing.assert_close(found.depth, 2 * ONE)
    assert found.typical == 2


def test_measured_depth_weighs_more_in_the_losses_alone():
    segment, pool = black(2)
    none = torch.zeros(segment[1].grid.size)
    segment[1].measured = MeasuredCells(none, none)
    for n in (0, 1):
        pool.add(n)
        for confidence in (0.5, 0.9):  # searched, then checked when the constants are there
            pool[n].set_depth(DenseDepth(2 * ONE, confidence * ONE, torch.tensor(2.0)))
            constants, depth = pool[n].constants, pool[n].dense
            factor = CONFIG.loss.measured_factor if n else 1.0
            torch.testing.assert_close(constants.confidence, factor * confidence * ONE)
            torch.testing.assert_close(depth.confidence, confidence * ONE)


def test_depth_weighs_more_beside_sure_jumps():
    _, pool = black(1, replace(CONFIG.loss, edge_factor=4.0, edge_reach=2))
    pool.add(0)
    depth = torch.full((32, 40), 3.0)
    depth[:, 20:] = 2
    confidence = torch.full((32, 40), 0.8)
    confidence[16:] = 0.4  # too unsure to say where it jumps
    pool[0].set_depth(DenseDepth(depth, confidence, torch.tensor(2.0)))
    constants = pool[0].constants
    expected = confidence.clone()
    expected[:18, 17:23] *= 4
    expected[16:18, 17:18] = expected[16:18, 22:23] = 1.6
    torch.testing.assert_close(constants.confidence, expected)
    torch.testing.assert_close(pool[0].dense.confidence, confidence)


def test_few_depths_stay_on_a_gpu_beside_their_file(monkeypatch):
    monkeypatch.setattr(view_arrays, "DEPTHS_ON_GPU", 2)
    segment, pool = black(4, resident=1)
    arrays, read, rows = pool.arrays, [], pool.arrays.table.views
    arrays.device = torch.device("cuda")  # nothing here asks a GPU

    def reading(table: ArrayTable, id: int, *rest: object) -> DenseDepth:
        read.append(id)
        return get_depth(table, id, *rest[:-1], torch.device("cpu"))

    monkeypatch.setattr(view_arrays, "get_depth", reading)
    for id in range(3):
        rows[id] = ViewRow()
        arrays.set_depth(id, DenseDepth((1.0 + id) * ONE, ONE, torch.tensor(1.0 + id)))
    arrays.depth(0)
    assert read == [0]
    segment[1].rescale(3.0)
    found = arrays.depth(1)
    assert read == [0]
    written = get_depth(arrays.table.arrays, 1, rows[1].depth, 3.0, torch.device("cpu"))
    torch.testing.assert_close(found.depth, 6 * ONE)
    torch.testing.assert_close(found.depth, written.depth)
    assert found.typical == 6
    rows[3] = ViewRow()
    arrays.set_depth(3, DenseDepth(ONE, ONE, torch.tensor(1.0)))  # 2 was used longer ago than 1
    arrays.depth(2)
    assert read == [0, 2]
    rows[1].depth = replace(rows[1].depth, typical=5.0)  # written anew meanwhile
    arrays.depth(1)
    assert read == [0, 2, 1]


def test_a_mask_takes_the_place_of_the_one_before():
    _, pool = black(1)
    mask = np.ones((64, 80), bool)
    mask[:, :20] = False
    pool.add(0, mask)
    assert pool[0].mask is not None
    assert int(pool[0].mask.sum()) == 32 * 30
    mask[:, 60:] = False
    pool.arrays.put_mask(0, mask)
    assert pool[0].mask is not None
    assert int(pool[0].mask.sum()) == 32 * 20
