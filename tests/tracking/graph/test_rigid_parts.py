"""Parts of a frame graph that one structure holds together."""

import pytest
import torch

from geogs.bundle.projection import project
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.graph.rigid_parts import largest_part
from planted_walk import SMALL, planted_tracker

COUNT = 7
AWAY = se3_exp(torch.tensor([0.4, 0.1, 0.0, 0.0, 0.3, 0.0], dtype=torch.float64))


def walked() -> FrameGraph:
    """Keyframes along a wall at their true poses, each matched with the two after it."""
    graph = planted_tracker(COUNT, SMALL)[0].map.graph
    graph.measure([(i, j) for i in range(COUNT) for j in range(i + 1, min(i + 3, COUNT))])
    return graph


def first_cells(graph: FrameGraph, fraction: float) -> torch.Tensor:
    """Some rows of the grid, from above."""
    return torch.arange(graph.keyframes.grid.size) < fraction * graph.keyframes.grid.size


def test_a_walk_is_of_one_piece_and_falls_apart_where_its_end_stands_elsewhere():
    graph = walked()
    assert largest_part(graph.keyframes, graph.edges) == set(range(COUNT))
    for n in range(4, COUNT):
        graph.keyframes[n].T_cw = AWAY @ graph.keyframes[n].T_cw
    assert largest_part(graph.keyframes, graph.edges) == {0, 1, 2, 3}


def test_what_moves_past_joins_nothing():
    """Between 3 and 4 cells are matched that agree with poses there, and with none before or
    after."""
    graph = walked()
    keyframes, grid = graph.keyframes, graph.keyframes.grid
    for n in range(4, COUNT):
        keyframes[n].T_cw = AWAY @ keyframes[n].T_cw
    people = first_cells(graph, 0.6)
    for (i, j), edge in graph.edges.items():
        if {i, j} == {3, 4}:
            T_ji = keyframes[j].T_cw @ se3_inverse(keyframes[i].T_cw)
            seen = project(grid.camera, grid.rays, T_ji[None], keyframes[i].inverse_depth[None])
            edge.pixels[people] = seen.pixels[0, people]
        else:
            edge.weight[people] = 0.0
    assert largest_part(keyframes, graph.edges) == {0, 1, 2, 3}


@pytest.mark.parametrize(("fraction", "members"), [(0.3, 4), (0.5, COUNT)])
def test_a_structure_is_handed_on_by_enough_of_the_cells(fraction, members):
    graph = walked()
    unmatched = ~first_cells(graph, fraction)
    for (i, j), edge in graph.edges.items():
        if min(i, j) <= 3 < max(i, j):
            edge.weight[unmatched] = 0.0
    assert len(largest_part(graph.keyframes, graph.edges)) == members
    assert len(largest_part(graph.keyframes, graph.edges, 0.2)) == COUNT


def test_keyframes_that_are_fixed_are_of_one_piece():
    """There are no edges between those of a saved map."""
    graph = walked()
    edges = {e: v for e, v in graph.edges.items() if not {0, 1, 2}.issuperset(e)}
    edges = {e: v for e, v in edges.items() if set(e) not in ({3, 4}, {2, 4}, {3, 5})}
    edges |= {e: graph.edges[e] for e in ((2, 3), (3, 2))}
    graph.measure([(0, 5)])
    edges |= {e: graph.edges[e] for e in ((0, 5), (5, 0))}
    assert largest_part(graph.keyframes, edges) == {0, 4, 5, 6}
    assert largest_part(graph.keyframes, edges, fixed={0, 1, 2}) == set(range(COUNT))


def test_without_edges_nothing_is_held():
    graph = walked()
    assert largest_part(graph.keyframes, {}) == frozenset()
