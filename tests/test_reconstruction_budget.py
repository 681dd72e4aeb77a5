"""The time that a reconstruction takes, by a clock that only the work moves on."""

import time
from collections.abc import Callable

import numpy as np
import pytest

from depth_scene import WORKING, make_scene
from geogs.mapping.mapper import Mapper
from geogs.mapping.time_budget import OutputCost
from geogs.mapping.training.cpu import CpuTrainer
from geogs.reconstruction import Reconstruction
from geogs.types import Trajectory
from posed_scene import SMALL

pytestmark = pytest.mark.system

READING, SEARCH, STEP = 0.1, 0.6, 0.02
OUTPUT = OutputCost(3.0, 0.5)
POINTS = np.random.default_rng(0).uniform([-1, -1, 2.5], [1, 1, 3.5], (500, 3))


class FakeClock:
    """Seconds that pass when they are told to."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch) -> FakeClock:
    """What all of the work costs; training steps change nothing."""
    clock, search_depths = FakeClock(), Mapper.search_depths

    def searching(mapper: Mapper, ids: list[int]) -> None:
        clock.now += SEARCH * len(ids)
        search_depths(mapper, ids)

    def step(trainer: CpuTrainer, batch: object, coarse: bool = False) -> float:
        clock.now += STEP
        return 0.0

    monkeypatch.setattr(time, "perf_counter", clock)
    monkeypatch.setattr(Mapper, "search_depths", searching)
    monkeypatch.setattr(CpuTrainer, "step", step)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    return clock


def reconstructed(clock: FakeClock, budget: float) -> tuple[Reconstruction, list[int]]:
    """Two of five images to begin with; and how many more there was said to be time for."""
    views, asked = make_scene().views, []
    scene = Reconstruction(WORKING, SMALL, budget=budget)
    poses = np.linalg.inv(np.stack([v.T_cw for v in views]))
    scene.know(Trajectory(np.arange(5.0), poses, np.ones(5, dtype=bool)))

    def add(numbers: range) -> None:
        for i in numbers:
            clock.now += READING
            scene.add(views[i].image, views[i].T_cw, index=i)

    def more(count_of: Callable[[], int]) -> None:
        scene.budget.output_cost = OUTPUT
        asked.append(count_of())
        add(range(2, min(2 + asked[0], 5)))

    add(range(2))
    scene.finish(POINTS, more=more)
    clock.now += OUTPUT.of(scene.with_depth)
    return scene, asked


def test_mesh_and_files_are_done_when_the_budget_ends(clock):
    start = clock.now
    scene, asked = reconstructed(clock, 20.0)
    assert clock.now - start == pytest.approx(20.0, rel=0.05)
    assert asked[0] >= 3
    assert scene.frames == scene.views == scene.with_depth == 5
    assert scene.mapper.table.place.steps > 100


def test_images_for_which_the_time_does_not_last_are_not_asked_for(clock):
    start = clock.now
    scene, asked = reconstructed(clock, 10.0)
    assert clock.now - start == pytest.approx(10.0, rel=0.05)
    assert 2 <= scene.with_depth < scene.frames == 5
    assert scene.with_depth <= asked[0] + 2
    assert len(scene.trajectory().timestamps) == 5
    assert len(scene.keyframe_trajectory().timestamps) == scene.with_depth
