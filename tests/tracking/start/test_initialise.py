"""The pair of views that a start begins with, and placing its keyframes."""

import cv2
import numpy as np
import pytest
import torch

from geogs.bundle.projection import project
from geogs.geometry.lie import se3_inverse
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.matching.two_view import (
    _pose_of,
    agreement,
    best_two_view,
    followed_longest,
    two_view,
    without,
)
from geogs.tracking.start.initialise import has_moved_surely, placed_after
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from tracking_scenes import CAMERA, pose, render


def test_a_keyframe_is_placed_on_the_depth_of_the_one_before_it() -> None:
    before, after = pose(0.1, 0.05, -0.1, 0.02), pose(0.25, 0.0, 0.6, 0.05)
    grid = SampleGrid(CAMERA)
    operator = ClassicalFlow(grid)
    store = KeyframeTable.on(grid).new_set()
    for n, T_wc in enumerate((before, after)):
        image, depth = render(T_wc)
        T_cw = torch.from_numpy(np.linalg.inv(before))
        state = store.add(n, n / 10, image, operator.encode(image), T_cw)
        d = 1 / depth[4:-3:8, 4:-3:8].reshape(-1)
        state.inverse_depth = torch.from_numpy(d.copy()).float()
    found = placed_after(FrameGraph(store, operator), *store)
    centre = se3_inverse(found)[:3, 3].numpy()
    assert np.linalg.norm(centre - after[:3, 3]) < 0.02  # the step is 72 cm
    # Where nothing is matched it stays where the one before it is.
    noise = np.random.default_rng(0).integers(0, 255, (144, 192, 3), np.uint8)
    unlike = store.add(2, 0.2, noise, operator.encode(noise), store[1].T_cw)
    kept = placed_after(FrameGraph(store, operator), store[0], unlike)
    torch.testing.assert_close(kept, store[0].T_cw)


@pytest.mark.parametrize("t", [(0.3, 0.1, 0.02), (-0.3, 0.0, 0.1), (0.0, 0.05, -0.3)])
def test_of_four_poses_of_an_essential_matrix_the_right_one_is_taken(t) -> None:
    """Against the motion that was, and OpenCV's choice."""
    rng = np.random.default_rng(3)
    points = rng.uniform((-2, -2, 2), (2, 2, 6), (400, 3))
    R, t = cv2.Rodrigues(np.array([0.1, -0.2, 0.05]))[0], np.array(t)
    moved = points @ R.T + t
    first, second = points / points[:, 2:], moved / moved[:, 2:]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    for E in (cross @ R, -cross @ R):
        found, along, seen = _pose_of(E, first, second)
        np.testing.assert_allclose(found, R, atol=1e-9)
        np.testing.assert_allclose(along, t / np.linalg.norm(t), atol=1e-9)
        count, theirs, direction, _ = cv2.recoverPose(E, first[:, :2], second[:, :2], np.eye(3))
        assert seen.sum() == count == 400
        np.testing.assert_allclose(theirs, found, atol=1e-9)
        np.testing.assert_allclose(direction[:, 0], along, atol=1e-9)


def _flow(depth: torch.Tensor, to: np.ndarray, of: torch.Tensor | None = None) -> FlowMatch:
    """Where a camera sees the cells of the first view, known to a tenth of a pixel."""
    grid = SampleGrid(CAMERA)
    T = torch.from_numpy(np.linalg.inv(to)).float()[None]
    at = project(CAMERA, grid.rays, T, 1 / depth[None])
    noise = 0.1 * torch.randn(at.pixels.shape, generator=torch.Generator().manual_seed(0))
    used = at.valid if of is None else at.valid & of
    weight = used[..., None].float().expand_as(at.pixels)
    return FlowMatch(at.pixels + noise, weight)


def test_a_pair_that_other_views_contradict_is_not_started_from() -> None:
    """The first two suit a scene and a motion that are not there, over more cells than others."""
    grid = SampleGrid(CAMERA)
    first = pose(0.0)
    depth = torch.from_numpy(render(first)[1][4:-3:8, 4:-3:8].reshape(-1).copy()).float()
    other = torch.from_numpy(np.random.default_rng(1).uniform(1.0, 4.0, grid.size)).float()
    right = torch.from_numpy(np.random.default_rng(2).random(grid.size) < 0.7)
    wrong = _flow(other, pose(0.0, 0.3, 0.1))
    flows = [wrong, *(_flow(depth, pose(0.06 * k, 0.0, 0.02 * k), right) for k in range(3, 9))]
    views = [two_view(CAMERA, match) for match in flows]
    assert views[0].good.sum() > max(int(v.good.sum()) for v in views[1:])
    assert min(v.parallax for v in views) > 3 * 2.0  # more of it makes none better
    n, view = best_two_view(CAMERA, flows, 2.0)
    assert n > 0
    ratio = view.inverse_depth[view.good] * depth[view.good]
    assert (ratio / ratio.median() - 1).abs().median() < 0.02
    of_all = [
        sum(float(agreement(grid, v, match).sum()) for match in flows) for v in (views[0], view)
    ]
    assert of_all[1] > 3 * of_all[0]


def test_a_car_ahead_that_is_followed_longest_is_not_started_from() -> None:
    """A sixth of the view moves with the camera, and more; of the rest ever less stays in sight."""
    grid = SampleGrid(CAMERA)
    depth = torch.from_numpy(render(pose(0.0))[1][4:-3:8, 4:-3:8].reshape(-1).copy()).float()
    across = (grid.pixels / grid.pixels.amax(0) - 0.5).abs().amax(1)
    car, beside = across < 0.2, across.argsort(descending=True)
    flows = []
    for k in range(1, 13):
        left = torch.zeros_like(car)
        left[beside[: int(0.6 * 0.7 ** (k - 1) * grid.size)]] = True
        scene = _flow(depth, pose(0.1 * k, 0.0, 0.03 * k), left & ~car)
        ahead = _flow(depth, pose(-0.04 * k, 0.05 * k, -0.01 * k), car)
        flows.append(
            FlowMatch(
                torch.where(car[:, None], ahead.pixels, scene.pixels), ahead.weight + scene.weight
            )
        )
    on_car = [float(match.sure()[0][car].sum() / match.sure()[0].sum()) for match in flows]
    assert on_car[0] < 0.4
    assert sum(share > 0.5 for share in on_car) > 6
    _, view = best_two_view(CAMERA, flows, 2.0)
    ratio = (view.inverse_depth * depth)[view.good & ~car]
    assert (ratio / ratio.median() - 1).abs().median() < 0.1
    assert view.good[~car].float().mean() > 2 * view.good[car].float().mean()


def test_what_is_followed_longest_is_found_where_the_rest_leaves_the_view() -> None:
    grid = SampleGrid(CAMERA)
    across = (grid.pixels / grid.pixels.amax(0) - 0.5).abs().amax(1)
    truck, order = across < 0.2, across.argsort(descending=True)

    def flow(left: int) -> FlowMatch:
        weight = truck.clone()
        weight[order[:left]] = True
        return FlowMatch(grid.pixels[None], weight.float()[None, :, None].expand(1, -1, 2))

    leaving = [flow(int(0.6 * 0.3**k * grid.size)) for k in range(9)]
    found = followed_longest(grid, leaving)
    assert bool(found[truck].all())
    assert not bool(found[across > 0.3].any())
    assert not bool((without(leaving[0], found).weight[0, found] > 0).any())
    assert not bool(followed_longest(grid, 9 * [flow(grid.size)]).any())  # that is the scene


def test_without_parallax_there_is_no_pair_to_start_from() -> None:
    depth = torch.full((SampleGrid(CAMERA).size,), 3.0)
    turned = [_flow(depth, pose(0.0, yaw=0.05 * k)) for k in range(1, 5)]
    assert best_two_view(CAMERA, turned, 2.0) is None
    assert best_two_view(CAMERA, [], 2.0) is None


@pytest.mark.parametrize("focal", [0.95, 1.0, 1.05])
def test_a_rotation_seen_through_another_focal_length_is_no_parallax(focal: float) -> None:
    """An essential matrix explains what that adds, with more than four pixels of parallax."""
    grid = SampleGrid(CAMERA)
    K = CAMERA.matrix().numpy() @ np.diag([focal, focal, 1.0])
    R = cv2.Rodrigues(np.array([0.02, 0.3, 0.0]))[0]
    rays = np.c_[grid.pixels.double().numpy(), np.ones(grid.size)] @ (K @ R @ np.linalg.inv(K)).T
    noise = np.random.default_rng(0).normal(0, 0.1, (grid.size, 2))
    pixels = torch.from_numpy(rays[:, :2] / rays[:, 2:] + noise).float()[None]
    match = FlowMatch(pixels, 50 * grid.inside(pixels).float()[..., None].expand_as(pixels))
    view = two_view(CAMERA, match)
    assert view is None or not has_moved_surely(grid, match, view.T_ji, abs(focal - 1))


def test_a_step_beside_a_turn_is_parallax() -> None:
    depth = torch.from_numpy(render(pose(0.0))[1][4:-3:8, 4:-3:8].reshape(-1).copy()).float()
    match = _flow(depth, pose(0.1, 0.05, 0.1, 0.02))
    match = FlowMatch(match.pixels, match.weight * 100)
    view = two_view(CAMERA, match)
    assert view is not None
    assert has_moved_surely(SampleGrid(CAMERA), match, view.T_ji, 0.05)


def test_guesses_do_not_outvote_parallax() -> None:
    """Of a bare wall a rotation explains what a network guesses as well as a motion does."""
    depth = torch.from_numpy(render(pose(0.0))[1][4:-3:8, 4:-3:8].reshape(-1).copy()).float()
    match = _flow(depth, pose(0.1, 0.05, 0.1, 0.02))
    weight = match.weight * 100
    view = two_view(CAMERA, FlowMatch(match.pixels, weight))
    assert view is not None
    weight[:, torch.arange(weight.shape[1]) % 8 > 0] = 1 / 12**2
    assert has_moved_surely(SampleGrid(CAMERA), FlowMatch(match.pixels, weight), view.T_ji, 0.05)
