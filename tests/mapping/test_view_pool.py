"""What the pool keeps of a view."""

from dataclasses import replace

import numpy as np
import torch

from geogs.config import Config
from geogs.depth.view import DenseDepth
from geogs.geometry.camera import Camera
from geogs.mapping.cameras import MapCameras
from geogs.mapping.view_pool import ViewPool
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
