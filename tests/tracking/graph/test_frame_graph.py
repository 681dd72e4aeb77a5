"""Frame graph: distances, choice of pairs, book-keeping of edges."""

import numpy as np
import pytest
import torch

from credulous_flow import CredulousFlow
from geogs.bundle.device_choice import grid_fields
from geogs.bundle.projection import project
from geogs.bundle.protocols import BundleOptions
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.graph.frame_graph import LEAST, NEAREST, FrameGraph, bounded_influence
from geogs.tracking.graph.proximity import frame_distances, proximity_pairs
from geogs.tracking.locate.frame_locator import FrameLocator
from geogs.tracking.matching.photometric_check import MIN_WINDOWS
from geogs.tracking.matching.pnp import pnp, pnp_features
from geogs.tracking.matching.sparse_features import FeatureMatches
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable
from planted_walk import PlantedFlow, true_inverse_depth, walk, walked_tracker
from tracking_scenes import CAMERA, pose, render

POSES = [pose(0.06 * k, yaw=0.01 * k) for k in range(6)]


def room_graph(poses: list[np.ndarray] = POSES) -> FrameGraph:
    """A graph whose keyframes have true poses and depths."""
    grid = SampleGrid(CAMERA)
    operator = ClassicalFlow(grid)
    store = KeyframeTable.on(grid).new_set()
    for k, T in enumerate(poses):
        image, depth = render(T)
        T_cw = torch.from_numpy(np.linalg.inv(T))
        state = store.add(k, k / 30, image, operator.encode(image), T_cw)
        d = 1 / depth[4:-3:8, 4:-3:8].reshape(-1)
        state.inverse_depth = torch.from_numpy(d.copy()).float()
        state.information = torch.full_like(state.inverse_depth, 1e4)
    return FrameGraph(store, operator)


def flat_store(centres: list[float]) -> KeyframeSet:
    """Cameras on a line in front of a wall at depth 2."""
    grid = SampleGrid(CAMERA)
    store = KeyframeTable.on(grid).new_set()
    for k, x in enumerate(centres):
        T = torch.from_numpy(np.linalg.inv(pose(x)))
        state = store.add(k, k / 30, np.zeros((144, 192, 3), np.uint8), None, T)
        state.inverse_depth = torch.full((grid.size,), 0.5)
    return store


def test_distance_of_a_sideways_step_is_its_flow():
    store = flat_store([0.0, 0.1])
    expected = 0.1 * 150.0 / 2  # f x / z
    distances = frame_distances(store, [(0, 1), (1, 0)])
    assert distances.tolist() == pytest.approx([expected] * 2, rel=1e-5)


def test_rotation_counts_only_its_share():
    store = flat_store([0.0, 0.0])
    store[1].T_cw = torch.from_numpy(np.linalg.inv(pose(0.0, yaw=0.1)))
    full = frame_distances(store, [(0, 1)], rotation_weight=1.0)
    share = frame_distances(store, [(0, 1)], rotation_weight=0.3)
    torch.testing.assert_close(share, 0.3 * full)


def test_views_that_do_not_overlap_are_infinitely_far():
    store = flat_store([0.0, 0.0, 3.0])
    store[1].T_cw = torch.from_numpy(np.linalg.inv(pose(0.0, yaw=np.pi)))
    assert torch.isinf(frame_distances(store, [(0, 1), (0, 2)])).all()


def test_neighbours_come_first_then_the_nearest_apart_from_each_other():
    # Out and back: 7 sees the place of 0 again.
    store = flat_store([0.0, 0.1, 0.2, 0.3, 0.4, 0.3, 0.1, 0.0])
    ids = store.ids
    pairs = proximity_pairs(store, ids, ids, [], 1, 0, 1.0, 100)
    assert [(k, k + 1) for k in range(7)] == pairs[:7]
    assert set(pairs[7:]) == {(3, 5), (1, 6), (0, 7)}
    apart = proximity_pairs(store, ids, ids, [], 1, 3, 1.0, 100)
    assert set(apart) < set(pairs)
    assert (0, 7) in apart or (1, 6) in apart
    assert len(proximity_pairs(store, ids, ids, [], 1, 0, 1.0, 8)) == 8
    assert (0, 7) not in proximity_pairs(store, ids, ids, [(0, 7)], 1, 0, 1.0, 100)


def test_only_moved_pairs_are_stale():
    graph = room_graph()
    pairs = [(0, 1), (1, 2), (3, 4)]
    assert graph.stale(pairs, 0.5) == pairs
    graph.measure(pairs)
    assert graph.stale(pairs, 0.5) == []
    state = graph.keyframes[4]
    moved = state.T_cw.clone()
    moved[0, 3] += 0.05
    state.T_cw = moved
    assert graph.stale(pairs, 0.5) == [(3, 4)]
    assert set(graph.edges) == {(0, 1), (1, 0), (1, 2), (2, 1), (3, 4), (4, 3)}


def test_a_removed_keyframe_leaves_no_edges():
    graph = room_graph()
    graph.measure([(0, 1), (1, 2), (0, 2)])
    graph.remove_keyframe(1)
    graph.keyframes.remove(1)
    assert graph.pairs == [(0, 2)]
    assert graph.keyframes.ids == [0, 2, 3, 4, 5]
    image = render(POSES[0])[0]
    new = graph.keyframes.add(9, 0.3, image, None, torch.eye(4, dtype=torch.float64))
    assert new.id == 6


def test_adjustment_of_real_flow_repairs_poses():
    graph = room_graph()
    truth = graph.keyframes.poses(graph.keyframes.ids).clone()
    ids = graph.keyframes.ids
    for k in ids[2:]:
        state = graph.keyframes[k]
        moved = state.T_cw.clone()
        moved[:3, 3] += torch.tensor([0.01, -0.008, 0.012])
        state.T_cw = moved
    for _ in range(3):
        graph.measure([(i, j) for i in ids for j in ids if i < j <= i + 3])
        result = graph.adjust(list(graph.edges), ids[2:], ids, BundleOptions(iterations=6))
    assert result is not None
    error = (graph.keyframes.poses(ids) - truth)[:, :3, 3].norm(dim=1)
    assert 100 * float(error.max()) < 0.6  # cm, disturbed by 1.75


def test_a_frame_is_located_from_a_guess_and_from_nothing():
    graph = room_graph(POSES[:1])
    state = graph.keyframes[0]
    locator = FrameLocator(graph.keyframes.grid, graph.operator, 0.12, 2.0, min_ncc=0.5)
    truth = pose(0.1, 0.02, 0.05, 0.04)
    encoded = graph.operator.encode(render(truth)[0])
    guess = torch.from_numpy(np.linalg.inv(pose(0.08, 0.01, 0.04, 0.03)))
    for motion in (locator.locate(state, encoded, guess), locator.relocate(state, encoded)):
        assert motion is not None
        centre = torch.linalg.inv(motion.T_cw)[:3, 3].numpy()
        assert 100 * np.linalg.norm(centre - truth[:3, 3]) < 0.3
        assert motion.matched > 0.5
        assert motion.check.correlation > 0.97


def test_noise_is_located_nowhere_even_if_the_flow_believes_in_it():
    state, grid = room_graph(POSES[:1]).keyframes[0], SampleGrid(CAMERA)
    operator = CredulousFlow(grid)
    believing = FrameLocator(grid, operator, 0.12, 2.0, min_ncc=-1.0)
    locator = FrameLocator(grid, operator, 0.12, 2.0, min_ncc=0.5)
    for seed in range(2):
        noise = np.random.default_rng(seed).integers(0, 255, (144, 192, 3), np.uint8)
        encoded = operator.encode(noise)
        found = believing.locate(state, encoded, state.T_cw)
        assert found is not None
        assert found.matched == 1.0
        assert found.residual < 1e-3
        assert found.check.windows > 300
        assert found.check.correlation < 0.1
        assert believing.relocate(state, encoded) is not None
        assert locator.locate(state, encoded, state.T_cw) is None
        assert locator.relocate(state, encoded) is None


def test_a_camera_that_jumped_is_found_by_features():
    graph = room_graph(POSES[:1])
    state = graph.keyframes[0]
    locator = FrameLocator(graph.keyframes.grid, graph.operator, 0.12, 2.0, min_ncc=0.5)
    truth = pose(0.2, 0.0, 0.9, 0.05)
    encoded = graph.operator.encode(render(truth)[0])
    assert locator.locate(state, encoded, state.T_cw) is None
    assert locator.relocate(state, encoded) is None
    motion = locator.relocate_any([state], encoded)
    assert motion is not None
    centre = torch.linalg.inv(motion.T_cw)[:3, 3].numpy()
    assert 100 * np.linalg.norm(centre - truth[:3, 3]) < 1.0
    assert motion.check.correlation > 0.8


def test_a_camera_that_sees_something_else_is_not_found_by_features():
    graph = room_graph(POSES[:1])
    state = graph.keyframes[0]
    locator = FrameLocator(graph.keyframes.grid, graph.operator, 0.12, 2.0, min_ncc=0.5)
    noise = np.random.default_rng(0).integers(0, 255, (144, 192, 3), np.uint8)
    for image in (noise, render(pose(0.0, yaw=np.pi))[0]):
        assert locator.relocate_any([state, state], graph.operator.encode(image)) is None


def test_pose_from_features_is_that_of_their_true_positions():
    state, grid = room_graph(POSES[:1]).keyframes[0], SampleGrid(CAMERA)
    T = torch.from_numpy(np.linalg.inv(pose(0.3, 0.1, 0.6, 0.1)))
    seen = project(CAMERA, grid.rays, T[None], state.inverse_depth[None]).pixels[0]
    chosen = torch.arange(0, grid.size, 9)
    second = seen[chosen].clone()
    second[::5] += 30.0  # wrong matches
    found = pnp_features(grid, state, FeatureMatches(grid.pixels[chosen], second))
    assert found is not None
    torch.testing.assert_close(found, T, atol=2e-3, rtol=0)
    state.information = torch.zeros_like(state.information)
    assert pnp_features(grid, state, FeatureMatches(grid.pixels[chosen], second)) is None


def test_a_frame_without_texture_is_located_only_where_it_was_expected():
    graph = room_graph(POSES[:1])
    locator = FrameLocator(graph.keyframes.grid, graph.operator, 0.12, 2.0, min_ncc=0.5)
    # Some grey levels are enough for the flow, and too little for evidence.
    flat = [(90 + render(T)[0] / 255 * 6).astype(np.uint8) for T in (POSES[0], pose(0.02))]
    here, encoded = map(graph.operator.encode, flat)
    first = graph.keyframes[0]
    state = graph.keyframes.add(1, 0.1, flat[0], here, first.T_cw)
    state.inverse_depth, state.information = first.inverse_depth, first.information
    motion = locator.locate(state, encoded, state.T_cw)
    assert motion is not None
    assert motion.matched > 0.3
    assert motion.check.windows < MIN_WINDOWS
    assert locator.locate(state, encoded, state.T_cw, is_expected=False) is None


def test_transferred_depth_matches_the_other_view():
    a, b = room_graph([pose(0.0), pose(0.1, yaw=0.03)]).keyframes
    T = b.T_cw @ torch.linalg.inv(a.T_cw)
    d, information = grid_fields(SampleGrid(CAMERA)).transfer(T, a.inverse_depth, a.information)
    seen = information > 0
    assert float(seen.float().mean()) > 0.8
    ratio = (d / b.inverse_depth - 1).abs()
    assert float(ratio[seen].median()) < 0.01
    assert float(ratio[seen].quantile(0.9)) < 0.06


def test_pnp_refuses_too_few_points():
    grid = SampleGrid(CAMERA)
    good = torch.zeros(grid.size, dtype=torch.bool)
    assert pnp(grid, torch.ones(grid.size), grid.pixels, good) is None


WIDE = Camera(fx=150.0, fy=150.0, cx=103.5, cy=79.5, width=208, height=160)
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
    grid = SampleGrid(WIDE)
    d = true_inverse_depth(T, grid)
    T = T @ se3_inverse(T[0])
    flow = PlantedFlow(grid, T, d, 0.2)
    tracker = walked_tracker(WIDE, flow, lambda n: np.full((4, 4, 3), (n, 0, 0), np.uint8))
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
    grid = SampleGrid(WIDE)
    d = true_inverse_depth(T, grid)
    d[:, -4 * grid.width :] *= 3.0
    d[:, -grid.width :] *= 10 / 3
    T = T @ se3_inverse(T[0])
    flow = PlantedFlow(grid, T, d, 0.2)
    tracker = walked_tracker(WIDE, flow, lambda n: np.full((4, 4, 3), (n, 0, 0), np.uint8))
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
