"""Keyframes that their images join: a rendered walk, part of which is moved elsewhere."""

import numpy as np
import pytest
import torch

from geogs.geometry.lie import se3_exp
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.graph.photometric_groups import largest_group
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from tracking_scenes import CAMERA, pose, render

COUNT = 8
AWAY = se3_exp(torch.tensor([0.4, 0.1, 0.0, 0.0, 0.3, 0.0], dtype=torch.float64))


def walked(images: list[np.ndarray] | None = None) -> FrameGraph:
    """Keyframes at their true poses with true depths, without edges."""
    grid = SampleGrid(CAMERA)
    operator = ClassicalFlow(grid)
    store = KeyframeTable.on(grid).new_set()
    for n in range(COUNT):
        T_wc = pose(0.08 * n, 0.02 * n)
        image, depth = render(T_wc)
        image = image if images is None else images[n]
        T_cw = torch.from_numpy(np.linalg.inv(T_wc))
        keyframe = store.add(n, n / 10, image, operator.encode(image), T_cw)
        d = 1 / depth[4:-3:8, 4:-3:8].reshape(-1)
        keyframe.inverse_depth = torch.from_numpy(d.copy()).float()
        keyframe.information = torch.ones(grid.size)
    return FrameGraph(store, operator)


def test_a_path_whose_end_stands_elsewhere_falls_apart():
    graph = walked()
    assert largest_group(graph, range(COUNT)) == 1.0
    for n in range(5, COUNT):
        graph.keyframes[n].T_cw = AWAY @ graph.keyframes[n].T_cw
    assert largest_group(graph, range(COUNT)) == 5 / 8


@pytest.mark.parametrize(("edges", "joined"), [([], 4 / 8), ([(3, 5)], 7 / 8), ([(2, 4)], 4 / 8)])
def test_other_edges_join_what_is_before_and_after_a_keyframe_out_of_place(edges, joined):
    graph = walked()
    graph.keyframes[4].T_cw = AWAY @ graph.keyframes[4].T_cw
    graph.edges.update({directed: None for i, j in edges for directed in ((i, j), (j, i))})
    assert largest_group(graph, range(COUNT)) == joined


def test_what_moves_joins_nothing_and_what_is_covered_is_seen_the_other_way():
    images = [keyframe.image.copy() for keyframe in walked().keyframes]
    noise = np.random.default_rng(0).integers(0, 255, images[4].shape, np.uint8)
    covered = CAMERA.width * 6 // 10
    images[4][:, :covered] = noise[:, :covered]
    graph = walked(images)
    keyframe = graph.keyframes[4]
    assert largest_group(graph, range(COUNT)) < 1.0  # it knows depths of what covers it
    keyframe.moving = torch.zeros(graph.keyframes.grid.size, dtype=torch.bool)
    keyframe.moving[graph.keyframes.grid.pixels[:, 0] < covered + 4] = True
    assert largest_group(graph, range(COUNT)) == 1.0


def test_images_without_texture_say_nothing():
    bare = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
    graph = walked(COUNT * [bare])
    graph.keyframes[4].T_cw = AWAY @ graph.keyframes[4].T_cw
    assert largest_group(graph, range(COUNT)) == 1.0
