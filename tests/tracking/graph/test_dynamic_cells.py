"""Cells that are held for moving."""

import numpy as np
import pytest
import torch

from geogs.bundle.projection import project
from geogs.bundle.protocols import BundleOptions
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.tracking.graph.dynamic_cells import (
    dynamic_cells,
    dynamic_fraction,
    propagated,
    static_weight,
    update_dynamic,
)
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.world.grid import SampleGrid
from planted_walk import planted_tracker

CAMERA = Camera(fx=150.0, fy=150.0, cx=103.5, cy=79.5, width=208, height=160)
"""26 x 20 cells."""
FRAMES = 6
PACE = np.array([4.0, 3.0])
"""Pixels from keyframe to keyframe by which a thing moves beside what the camera does."""
THRESHOLD = 3.0


def walked() -> FrameGraph:
    """Keyframes along a wall, each matched with all, their poses and depths true."""
    graph = planted_tracker(FRAMES, CAMERA)[0].map.graph
    graph.measure([(i, j) for i in range(FRAMES) for j in range(i + 1, FRAMES)])
    return graph


def block(rows: slice, columns: slice) -> torch.Tensor:
    mask = torch.zeros(20, 26, dtype=torch.bool)
    mask[rows, columns] = True
    return mask.reshape(-1)


def plant(graph: FrameGraph, masks: dict[int, torch.Tensor]) -> None:
    """Let cells of some keyframes show something that moves at an even pace."""
    for (i, j), edge in graph.edges.items():
        if i in masks:
            edge.pixels[masks[i]] += torch.from_numpy(PACE * (j - i)).float()


def judged(graph: FrameGraph) -> None:
    update_dynamic(graph.keyframes, graph.edges, list(graph.edges), THRESHOLD)


def test_a_thing_that_moves_is_found_and_nothing_else_is():
    graph = walked()
    masks = {k: block(slice(5, 16), slice(4 + 2 * k, 13 + 2 * k)) for k in range(FRAMES)}
    plant(graph, masks)
    judged(graph)
    for k, truth in masks.items():
        held = graph.keyframes[k].moving
        assert held is not None
        assert float(held[truth].float().mean()) > 0.95
        if k == 0:
            continue  # what lies left of it is in no other image, and goes with its surroundings
        around = torch.nn.functional.max_pool2d(truth.view(1, 1, 20, 26).float(), 5, 1, 2)
        assert float(held[around.view(-1) == 0].float().mean()) < 0.03
    expected = sum(float(graph.keyframes[k].moving.float().mean()) for k in masks) / FRAMES
    assert dynamic_fraction(graph.keyframes) == pytest.approx(expected)


def test_nothing_moves_where_nothing_does():
    graph = walked()
    judged(graph)
    assert dynamic_fraction(graph.keyframes) == 0


def test_a_thing_that_fills_one_keyframe_is_not_taken_for_the_scene():
    graph = walked()
    filled = block(slice(0, 20), slice(0, 18))
    plant(graph, {3: filled})
    judged(graph)
    held = graph.keyframes[3].moving
    assert held is not None
    assert float(held[filled].float().mean()) > 0.9
    assert float(held[block(slice(0, 20), slice(21, 26))].float().mean()) < 0.1


def test_a_keyframe_that_suits_no_other_does_not_move():
    graph = walked()
    for (i, _), edge in graph.edges.items():
        if i == 2:
            noise = np.random.default_rng(i).normal(0, 4, edge.pixels.shape)
            edge.pixels += torch.from_numpy(noise).float()
    judged(graph)
    assert dynamic_fraction(graph.keyframes) == 0


def test_poses_are_those_of_the_scene_once_what_moves_is_left_out():
    graph, errors = walked(), []
    plant(graph, {k: block(slice(3, 20), slice(2, 14)) for k in range(FRAMES)})
    store = graph.keyframes
    ids, true = store.ids, store.poses(store.ids)
    for _ in range(2):
        graph.adjust(list(graph.edges), ids[1:], ids, BundleOptions(6, huber=0.5))
        graph.update_dynamic(ids, THRESHOLD)
        centres, truth = (se3_inverse(T)[:, :3, 3] for T in (store.poses(ids), true))
        scale = (centres * truth).sum() / centres.square().sum()
        errors.append(float((scale * centres - truth).norm(dim=1).max()))
    assert errors[1] < 0.25 * errors[0]
    assert errors[1] < 0.02
    assert all(not bool((k.information[k.moving] > 0).all()) for k in store)


def test_matches_from_and_to_what_moves_weigh_nothing():
    graph = walked()
    pairs = [(0, 1), (1, 0)]
    pixels = graph.keyframes.grid.pixels.expand(2, -1, -1) + 1.0  # the cells themselves
    weight = torch.ones_like(pixels)
    assert static_weight(graph.keyframes, pairs, pixels, weight) is weight
    graph.keyframes[0].moving = block(slice(0, 3), slice(0, 5))
    found = static_weight(graph.keyframes, pairs, pixels, weight)
    expected = (~graph.keyframes[0].moving).float()[None, :, None].expand_as(weight)
    torch.testing.assert_close(found, expected)


def test_a_hold_goes_with_the_flow_where_there_is_some():
    grid = SampleGrid(CAMERA)
    held = block(slice(4, 10), slice(6, 12))
    pixels = grid.pixels + torch.tensor([16.0, 0.0])  # two cells to the right
    weight = torch.ones_like(pixels)
    weight[: 26 * 6] = 0
    expected = block(slice(6, 10), slice(4, 10))
    assert torch.equal(propagated(grid, held, pixels, weight), expected)
    assert propagated(grid, None, pixels, weight) is None


def held_cells(total: torch.Tensor, count: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
    return dynamic_cells(SampleGrid(CAMERA), total[None], count[None], before[None], THRESHOLD)[0]


def test_cells_of_a_keyframe_without_matches_stay_what_they_were():
    before, none = block(slice(0, 20), slice(0, 8)), torch.zeros(20 * 26)
    assert torch.equal(held_cells(none, none, before), before)
    assert not bool(held_cells(none + 0.5, none + 1, before).any())


def test_what_was_held_and_keeps_its_place_in_the_image_is_held_on():
    """A car ahead suits its epipolar lines: as if it were infinitely far. So does a wall near by,
    which is let go."""
    graph = walked()
    ahead, wall = block(slice(6, 14), slice(2, 10)), block(slice(6, 14), slice(16, 24))
    store = graph.keyframes
    T_cw, grid = store.poses(store.ids), store.grid
    for (i, j), edge in graph.edges.items():
        T_ji = (T_cw[j] @ se3_inverse(T_cw[i]))[None].float()
        far = project(grid.camera, grid.rays, T_ji, torch.zeros(1, grid.size)).pixels[0]
        edge.pixels[ahead] = far[ahead]
    judged(graph)
    assert dynamic_fraction(store) == 0
    for keyframe in store:
        keyframe.moving = ahead | wall
    judged(graph)
    for keyframe in store:
        assert keyframe.moving is not None
        assert float(keyframe.moving[ahead].float().mean()) == 1
        assert float(keyframe.moving[wall].float().mean()) < 0.2


def test_what_moves_includes_its_inside_that_is_not_matched():
    thing, inside = block(slice(4, 16), slice(5, 16)), block(slice(8, 12), slice(8, 12))
    count = torch.where(inside, 0.0, 5.0)
    held = held_cells(torch.where(thing, 8.0, 0.5) * count, count, torch.zeros_like(thing))
    assert bool(held[inside].all())
    assert float(held[thing].float().mean()) > 0.95


def test_a_threshold_of_zero_judges_nothing():
    graph = walked()
    graph.update_dynamic(graph.keyframes.ids, 0.0)
    assert all(k.moving is None for k in graph.keyframes)


@pytest.mark.gpu
def test_a_gpu_holds_the_same_cells():
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA GPU")
    graph = walked()
    plant(graph, {k: block(slice(5, 16), slice(6, 16)) for k in range(FRAMES)})
    judged(graph)
    expected = [k.moving for k in graph.keyframes]
    store, device = graph.keyframes, torch.device("cuda")
    store.table.grid = SampleGrid(CAMERA, device)
    for keyframe in store:
        keyframe.inverse_depth, keyframe.moving = keyframe.inverse_depth.to(device), None
    for edge in graph.edges.values():
        edge.pixels, edge.weight = edge.pixels.to(device), edge.weight.to(device)
    judged(graph)
    for keyframe, held in zip(store, expected, strict=True):
        assert keyframe.moving.device.type == "cuda"
        assert float((keyframe.moving.cpu() != held).float().mean()) < 0.01
