"""What the pool keeps of a view."""

from dataclasses import replace

import numpy as np
import torch

from geogs.config import Config
from geogs.depth.depth_view import DenseDepth
from geogs.geometry.camera import Camera
from geogs.mapping import view_arrays
from geogs.mapping.view_arrays import MapCameras, get_depth
from geogs.world.arrays import ArrayTable
from geogs.world.cell_depths import MeasuredCells
from geogs.world.map import ViewRow
from keyframe_samples import Sample, segment_of, views_of

CAMERA = Camera(fx=60.0, fy=60.0, cx=39.5, cy=31.5, width=80, height=64)


def test_depth_of_what_moves_is_not_believed():
    image = np.zeros((64, 80, 3), np.uint8)
    keyframe = segment_of([Sample(0, image, torch.eye(4, dtype=torch.float64))], CAMERA)[0]
    config = replace(Config().mapping, render_long_edge=40)
    pool = views_of(keyframe.table, MapCameras.of(CAMERA, config), config.loss)
    pool.add(0)
    moving = torch.zeros(8, 10, dtype=torch.bool)
    moving[2:5, 3:7] = True
    keyframe.moving = moving.reshape(-1)
    one = torch.ones(32, 40)
    pool[0].set_depth(DenseDepth(2 * one, 0.9 * one, torch.tensor(2.0)))
    found = pool[0].dense
    expected = torch.full((32, 40), 0.9)
    expected[8:20, 12:28] = 0
    torch.testing.assert_close(found.confidence, expected)
    torch.testing.assert_close(found.depth, 2 * one)
    assert found.typical == 2


def test_measured_depth_weighs_more_in_the_losses_alone():
    image = np.zeros((64, 80, 3), np.uint8)
    poses = torch.eye(4, dtype=torch.float64)
    segment = segment_of([Sample(n, image, poses) for n in (0, 1)], CAMERA)
    config = replace(Config().mapping, render_long_edge=40)
    pool = views_of(segment.table, MapCameras.of(CAMERA, config), config.loss)
    none = torch.zeros(segment[1].grid.size)
    segment[1].measured = MeasuredCells(none, none)
    one = torch.ones(32, 40)
    for n in (0, 1):
        pool.add(n)
        for confidence in (0.5, 0.9):  # searched, then checked when the constants are there
            pool[n].set_depth(DenseDepth(2 * one, confidence * one, torch.tensor(2.0)))
            constants, depth = pool[n].constants, pool[n].dense
            factor = config.loss.measured_factor if n else 1.0
            torch.testing.assert_close(constants.confidence, factor * confidence * one)
            torch.testing.assert_close(depth.confidence, confidence * one)


def test_depth_weighs_more_beside_sure_jumps():
    image = np.zeros((64, 80, 3), np.uint8)
    keyframe = segment_of([Sample(0, image, torch.eye(4, dtype=torch.float64))], CAMERA)[0]
    config = replace(Config().mapping, render_long_edge=40)
    loss = replace(config.loss, edge_factor=4.0, edge_reach=2)
    pool = views_of(keyframe.table, MapCameras.of(CAMERA, config), loss)
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
    image, eye = np.zeros((64, 80, 3), np.uint8), torch.eye(4, dtype=torch.float64)
    segment = segment_of([Sample(n, image, eye) for n in range(4)], CAMERA, resident=1)
    config = replace(Config().mapping, render_long_edge=40)
    arrays = views_of(segment.table, MapCameras.of(CAMERA, config), config.loss).arrays
    arrays.device = torch.device("cuda")  # nothing here asks a GPU
    one, read, rows = torch.ones(32, 40), [], arrays.table.views

    def reading(table: ArrayTable, id: int, *rest: object) -> DenseDepth:
        read.append(id)
        return get_depth(table, id, *rest[:-1], torch.device("cpu"))

    monkeypatch.setattr(view_arrays, "get_depth", reading)
    for id in range(3):
        rows[id] = ViewRow()
        arrays.set_depth(id, DenseDepth((1.0 + id) * one, one, torch.tensor(1.0 + id)))
    arrays.depth(0)
    assert read == [0]
    segment[1].rescale(3.0)
    found = arrays.depth(1)
    assert read == [0]
    written = get_depth(arrays.table.arrays, 1, rows[1].depth, 3.0, torch.device("cpu"))
    torch.testing.assert_close(found.depth, 6 * one)
    torch.testing.assert_close(found.depth, written.depth)
    assert found.typical == 6
    rows[3] = ViewRow()
    arrays.set_depth(3, DenseDepth(one, one, torch.tensor(1.0)))  # 2 was used longer ago than 1
    arrays.depth(2)
    assert read == [0, 2]
    rows[1].depth = replace(rows[1].depth, typical=5.0)  # written anew meanwhile
    arrays.depth(1)
    assert read == [0, 2, 1]


def test_a_mask_takes_the_place_of_the_one_before():
    image = np.zeros((64, 80, 3), np.uint8)
    keyframe = segment_of([Sample(0, image, torch.eye(4, dtype=torch.float64))], CAMERA)[0]
    config = replace(Config().mapping, render_long_edge=40)
    pool = views_of(keyframe.table, MapCameras.of(CAMERA, config), config.loss)
    mask = np.ones((64, 80), bool)
    mask[:, :20] = False
    pool.add(0, mask)
    assert pool[0].mask is not None
    assert int(pool[0].mask.sum()) == 32 * 30
    mask[:, 60:] = False
    pool.arrays.put_mask(0, mask)
    assert pool[0].mask is not None
    assert int(pool[0].mask.sum()) == 32 * 20
