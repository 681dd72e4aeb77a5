"""The frame graph hands an operator's memory and damping of every directed edge on."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from geogs.bundle.terms import DepthDamping
from geogs.tracking.flow.flow_operator import FlowOperator, Memories
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from tracking_scenes import CAMERA, pose

GRID = SampleGrid(CAMERA)


class CountingFlow:
    """Finds what it is given, and counts how often it has measured each direction."""

    def encode(self, image: np.ndarray) -> int:
        return int(image[0, 0, 0])

    def texture(self, encoded: int) -> float:
        return 1.0

    def grey(self, encoded: int) -> torch.Tensor:
        return torch.full((CAMERA.height, CAMERA.width), float(encoded))

    def measure(
        self,
        first: Sequence[int],
        second: Sequence[int],
        forward: torch.Tensor | None = None,
        backward: torch.Tensor | None = None,
        fine: bool = True,
        memory: Memories | None = None,
    ) -> tuple[FlowMatch, FlowMatch]:
        memory = memory or [(None, None)] * len(first)
        return tuple(
            self._match(source, target, [m[n] for m in memory])
            for n, (source, target) in enumerate(((first, second), (second, first)))
        )

    @staticmethod
    def _match(source, target, before) -> FlowMatch:
        pixels = GRID.pixels.expand(len(source), -1, -1).clone()
        counted = [
            (a, b, 1 if old is None else old[2] + 1)
            for a, b, old in zip(source, target, before, strict=True)
        ]
        damping = torch.tensor([100.0 * c[0] + c[2] for c in counted])[:, None]
        return FlowMatch(
            pixels, torch.ones_like(pixels), damping.expand(-1, GRID.size), tuple(counted)
        )


@pytest.fixture
def graph() -> FrameGraph:
    store, operator = KeyframeTable.on(GRID).new_set(), CountingFlow()
    for k in range(4):
        image = np.full((CAMERA.height, CAMERA.width, 3), k + 1, np.uint8)
        T = torch.from_numpy(np.linalg.inv(pose(0.1 * k)))
        store.add(k, k / 30, image, operator.encode(image), T)
    return FrameGraph(store, operator)


def test_each_direction_gets_its_own_memory_back(graph):
    assert isinstance(graph.operator, FlowOperator)
    graph.measure([(0, 1), (1, 2)])
    graph.measure([(2, 3), (0, 1)])
    graph.measure([(0, 1)])
    assert {e: v.memory for e, v in graph.edges.items()} == {
        (0, 1): (1, 2, 3),
        (1, 0): (2, 1, 3),
        (1, 2): (2, 3, 1),
        (2, 1): (3, 2, 1),
        (2, 3): (3, 4, 1),
        (3, 2): (4, 3, 1),
    }


def test_memory_of_resting_edges_is_released(graph):
    graph.measure([(0, 1), (1, 2), (2, 3)])
    graph.release({3})
    kept = [e for e, v in graph.edges.items() if v.memory is not None]
    assert kept == [(2, 3), (3, 2)]
    assert float(graph.edges[0, 1].damping[0]) == 101
    graph.measure([(0, 1)])
    assert graph.edges[0, 1].memory == (1, 2, 1)


def test_damping_of_a_frame_is_the_mean_over_the_edges_that_leave_it(graph):
    graph.measure([(0, 1), (1, 2), (2, 3)])
    graph.measure([(1, 2)])
    problem, ids = graph.problem(list(graph.edges), [2, 3], [0, 1, 2])
    assert ids == [0, 1, 2, 3]
    (damping,) = problem.depth_terms
    assert isinstance(damping, DepthDamping)
    assert damping.curvature.shape == (4, GRID.size)
    expected = torch.tensor([101.0, 201.5, 301.5, 401.0])
    torch.testing.assert_close(damping.curvature[:, 5], expected)
    for edge in graph.edges.values():
        edge.damping = None
    assert graph.problem(list(graph.edges), [2, 3], [0, 1, 2])[0].depth_terms == ()
