"""What the pool keeps of a view."""

from dataclasses import replace

import numpy as np
import torch

from geogs.config import Config
from geogs.depth.view import DenseDepth
from geogs.geometry.camera import Camera
from geogs.mapping.cameras import MapCameras
from geogs.mapping.held_depths import HeldDepths
from geogs.mapping.stored_maps import StoredDepth
from geogs.mapping.view_pool import ViewPool
from geogs.world.archive import Archive
from geogs.world.keyframes import MeasuredCells
from keyframe_samples import Sample, segment_of

CAMERA = Camera(fx=60.0, fy=60.0, cx=39.5, cy=31.5, width=80, height=64)


def test_depth_of_what_moves_is_not_believed():
    image = np.zeros((64, 80, 3), np.uint8)
    keyframe = segment_of([Sample(0, image, torch.eye(4, dtype=torch.float64))], CAMERA)[0]
    config = replace(Config().mapping, render_long_edge=40)
    pool = ViewPool(MapCameras.of(CAMERA, config), config.loss, torch.device("cpu"), 4)
    pool.add(keyframe)
    moving = torch.zeros(8, 10, dtype=torch.bool)
    moving[2:5, 3:7] = True
    keyframe.moving = moving.reshape(-1)
    one = torch.ones(32, 40)
    pool.set_depth(0, DenseDepth(2 * one, 0.9 * one, torch.tensor(2.0)))
    found = pool.depth(0)
    assert found is not None
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
    pool = ViewPool(MapCameras.of(CAMERA, config), config.loss, torch.device("cpu"), 4)
    none = torch.zeros(segment[1].grid.size)
    segment[1].measured = MeasuredCells(none, none)
    one = torch.ones(32, 40)
    for n in (0, 1):
        pool.add(segment[n])
        for confidence in (0.5, 0.9):  # searched, then checked when the constants are there
            pool.set_depth(n, DenseDepth(2 * one, confidence * one, torch.tensor(2.0)))
            constants, depth = pool.constants(n), pool.depth(n)
            assert constants is not None
            assert depth is not None
            factor = config.loss.measured_factor if n else 1.0
            torch.testing.assert_close(constants.confidence, factor * confidence * one)
            torch.testing.assert_close(depth.confidence, confidence * one)


def test_few_depths_are_held_beside_their_archive():
    one, archive = torch.ones(4, 5), Archive()
    held = HeldDepths(torch.device("cuda"), limit=2)  # nothing here asks a GPU
    stored = {}
    for id in range(3):
        depth = DenseDepth((1.0 + id) * one, one, torch.tensor(1.0 + id))
        stored[id] = StoredDepth.of(depth, 1.0, archive)
        held.put(id, stored[id], depth)
    assert held.get(0, stored[0], 1.0) is None
    found = held.get(1, stored[1], 3.0)
    assert found is not None
    torch.testing.assert_close(found.depth, 6 * one)
    torch.testing.assert_close(found.depth, stored[1].load(3.0, torch.device("cpu")).depth)
    assert found.typical == 6
    held.put(3, stored[0], depth)  # 2 was used longer ago than 1
    assert held.get(2, stored[2], 1.0) is None
    assert held.get(1, stored[0], 1.0) is None  # archived anew meanwhile
