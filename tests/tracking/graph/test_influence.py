"""What very near cells may say of a pose is bounded, so that what moves cannot bend it."""

import numpy as np
import pytest
import torch

from geogs.bundle.protocols import BundleOptions
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.graph.influence import LEAST, NEAREST, bounded_influence
from geogs.world.grid import SampleGrid
from planted_walk import PlantedFlow, true_inverse_depth, walk, walked_tracker

CAMERA = Camera(fx=150.0, fy=150.0, cx=103.5, cy=79.5, width=208, height=160)
"""26 x 20 cells."""


def test_influence_is_bounded_beyond_a_multiple_of_what_is_usual():
    depth = torch.randn(4, 31, generator=torch.Generator().manual_seed(0)).mul(2.0).exp()
    found = bounded_influence(depth)
    for row, factors in zip(depth.tolist(), found.tolist(), strict=True):
        usual = sorted(row)[22]
        for d, factor in zip(row, factors, strict=True):
            expected = max(min(1.0, (NEAREST * usual / d) ** 2), LEAST)
            assert abs(factor - expected) < 1e-5
    assert 0.03 < float((found < 1).float().mean()) < 0.5


def test_what_is_near_keeps_a_say_before_a_background_without_end():
    depth = torch.full((1, 100), 1e-8)
    depth[:, :20] = 0.5
    assert bounded_influence(depth)[0, :20].tolist() == pytest.approx([LEAST] * 20)


def closely_followed() -> FrameGraph:
    """Six keyframes of a walk, of which the last three hardly move, all matched with all; a thing
    that walks through those three is matched among them alone."""
    T = walk(12)[:6]
    for k in (4, 5):
        step = torch.tensor([0.01, 0.0, 0.0, 0.0, 0.02, 0.0], dtype=torch.float64)
        T[k] = se3_exp((k - 3) * step) @ T[3]
    grid = SampleGrid(CAMERA)
    d = true_inverse_depth(T, grid)
    T = T @ se3_inverse(T[0])
    flow = PlantedFlow(grid, T, d, 0.2)
    tracker = walked_tracker(CAMERA, flow, lambda n: np.full((4, 4, 3), (n, 0, 0), np.uint8))
    graph = tracker.map.graph
    graph.measure([(i, j) for i in range(6) for j in range(i + 1, 6)])
    walker = torch.zeros(grid.height, grid.width, dtype=torch.bool)
    walker[6:15, 11:15] = True
    for (i, j), edge in graph.edges.items():
        if i >= 3 and j >= 3:
            edge.pixels[walker.view(-1)] += torch.tensor([3.0, 6.0]) * (j - i)
        else:
            edge.weight[walker.view(-1)] = 0
    return graph


def error_of_last(graph: FrameGraph, bounded: bool) -> float:
    """Of its centre, in metres, after three rounds like those of each new keyframe."""
    store = graph.keyframes
    truth = se3_inverse(store.poses(store.ids))[:, :3, 3]
    for _ in range(3):
        options = BundleOptions(6, huber=0.5)
        graph.adjust(list(graph.edges), store.ids[3:], store.ids, options, bounded=bounded)
        graph.update_dynamic(store.ids, 3.0)
    centres = se3_inverse(store.poses(store.ids))[:, :3, 3]
    return float((centres - truth)[5].norm())


def test_what_moves_past_a_camera_that_rests_does_not_move_it():
    bounded = error_of_last(closely_followed(), bounded=True)
    assert bounded < 0.5 * error_of_last(closely_followed(), bounded=False)
    assert bounded < 0.003


def test_what_matches_say_of_depths_is_not_bounded():
    """A floor three times as near as all else, and some of it ten times: its depths are found, and
    as well known as without a bound."""
    T = walk(12)[:5]
    grid = SampleGrid(CAMERA)
    d = true_inverse_depth(T, grid)
    d[:, -4 * grid.width :] *= 3.0
    d[:, -grid.width :] *= 10 / 3
    T = T @ se3_inverse(T[0])
    flow = PlantedFlow(grid, T, d, 0.2)
    tracker = walked_tracker(CAMERA, flow, lambda n: np.full((4, 4, 3), (n, 0, 0), np.uint8))
    graph, store = tracker.map.graph, tracker.keyframes
    graph.measure([(i, j) for i in range(5) for j in range(i + 1, 5)])
    found = []
    for bounded in (False, True):
        options = BundleOptions(8, huber=1e6)
        graph.adjust(list(graph.edges), store.ids[1:], store.ids, options, bounded=bounded)
        found.append([store.inverse_depths(store.ids), store.informations(store.ids)])
    (plain, said), (depth, information) = found
    is_near = (bounded_influence(plain) < 1) & (said > 0)
    assert 0.05 < float(is_near.float().mean()) < 0.3
    assert float((depth[is_near] / plain[is_near] - 1).abs().median()) < 0.02
    assert float((information[is_near] / said[is_near] - 1).abs().median()) < 0.05
