"""The mapper beside tracking works with poses of the time when it was told something."""

import numpy as np
import torch

from geogs.config import preset
from geogs.geometry.camera import Camera
from geogs.keyframes.grid import SampleGrid
from geogs.keyframes.store import KeyframeStore
from geogs.mapping.background import BackgroundMapper
from geogs.mapping.mapper import Mapper

CAMERA = Camera(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)


def shifted(x: float) -> torch.Tensor:
    T = torch.eye(4, dtype=torch.float64)
    T[0, 3] = x
    return T


def test_each_thing_is_told_with_the_poses_of_its_time():
    config, store = preset("fast").mapping, KeyframeStore(SampleGrid(CAMERA))
    segment, image = store.new_segment(), np.zeros((48, 64, 3), np.uint8)
    background = BackgroundMapper(store, lambda keyframes: Mapper(keyframes, config))
    seen: list[float] = []
    for n in range(4):
        segment.add(n, n / 30, image, None, shifted(0.0))
        segment[0].T_cw = shifted(float(n))
        background.observe(n)
        background._tell(lambda mapper: seen.append(float(mapper.views[0].T_cw[0, 3])))
        segment[0].T_cw = shifted(-1.0)  # of which nobody is told
    mapper = background.settled()
    assert seen == [0.0, 1.0, 2.0, 3.0]
    assert float(mapper.views[0].T_cw[0, 3]) == -1.0
    assert mapper.views[0].keyframe is store[0]
