"""The mapper beside tracking works with poses of the time when it was told something."""

import threading
import time

import numpy as np
import torch

from geogs.concurrent import PriorityGate
from geogs.config import preset
from geogs.executors.background_mapper import MAX_WAITING, BackgroundMapper
from geogs.geometry.camera import Camera
from geogs.mapping.mapper import Mapper, never_pause
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable

LONG = 0.5
"""Seconds that mapping waits here at most."""
CAMERA = Camera(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)


def shifted(x: float) -> torch.Tensor:
    T = torch.eye(4, dtype=torch.float64)
    T[0, 3] = x
    return T


def test_each_thing_is_told_with_the_poses_of_its_time():
    config, store = preset("fast").mapping, KeyframeTable.on(SampleGrid(CAMERA))
    segment, image = store.new_set(), np.zeros((48, 64, 3), np.uint8)
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


def test_mapping_waits_while_a_frame_is_tracked_unless_it_is_far_behind():
    config, store = preset("fast").mapping, KeyframeTable.on(SampleGrid(CAMERA))
    background = BackgroundMapper(store, lambda keyframes: Mapper(keyframes, config))
    background._gate = PriorityGate(LONG)
    waits: list[float] = []

    def pause(mapper: Mapper) -> None:
        start = time.perf_counter()
        mapper.pause()
        waits.append(time.perf_counter() - start)

    with background.giving_way():
        background.ask(pause)
    background.ask(pause)
    with background.giving_way():
        release = threading.Event()
        background._tell(lambda _: release.wait(10))
        for _ in range(MAX_WAITING + 2):
            background._tell(pause)
        release.set()
        while len(waits) < 3:
            time.sleep(0.001)
    mapper = background.settled()
    assert waits[0] > 0.9 * LONG
    assert waits[1] < 0.5 * LONG
    assert waits[2] < 0.5 * LONG  # too much was waiting
    assert mapper.pause is never_pause
