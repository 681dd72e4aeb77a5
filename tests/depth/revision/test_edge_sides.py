"""Which side of an edge pixels are on: support against a loop, and a ball that is too large."""

import numpy as np
import torch
from torch.nn.functional import max_pool2d

from depth_scene import RENDER, WORKING, make_scene
from geogs.depth.classical import CpuDepthEngine
from geogs.depth.depth_view import DenseDepth, PosedDepth
from geogs.depth.revision.edge_sides import (
    AGREES,
    MOVED_CONFIDENCE,
    SEES_THROUGH,
    on_their_sides,
    support,
)
from geogs.geometry.camera import Camera

LARGE = Camera(fx=320.0, fy=320.0, cx=191.5, cy=143.5, width=384, height=288)


def dense(depth, confidence=0.9):
    depth = torch.from_numpy(depth)
    return DenseDepth(depth, torch.full_like(depth, confidence), depth.median())


def slow_support(depth, T_cw, others, camera):
    """Pixel by pixel and view by view."""
    found, K = np.zeros(depth.shape), camera.matrix().numpy()
    for v, u in np.ndindex(*depth.shape):
        for other in others:
            point = np.linalg.inv(K) @ [u, v, 1] * float(depth[v, u])
            x, y, z = K @ (other.T_cw @ np.linalg.inv(T_cw) @ [*point, 1])[:3]
            x, y = x / z, y / z
            if z <= 0 or not (0 <= x <= camera.width - 1 and 0 <= y <= camera.height - 1):
                continue
            j, i = min(int(x), camera.width - 2), min(int(y), camera.height - 2)
            weights = np.outer([1 - (y - i), y - i], [1 - (x - j), x - j])
            maps = other.depth.depth.numpy(), other.depth.confidence.numpy()
            there, confidence = ((weights * m[i : i + 2, j : j + 2]).sum() for m in maps)
            found[v, u] += confidence * (abs(np.log(z / there)) < AGREES)
            found[v, u] -= confidence * (z / there < SEES_THROUGH)
    return found


def test_support_is_that_of_a_loop():
    scene, rng = make_scene(), np.random.default_rng(1)
    others = []
    for view, truth in zip(scene.views[1:], scene.truth[1:], strict=True):
        depth = dense((truth * rng.choice([0.97, 1.0, 1.1], truth.shape)).astype(np.float32))
        depth.confidence[:] = torch.from_numpy(rng.random(truth.shape).astype(np.float32))
        others.append(PosedDepth(view.T_cw, depth))
    depth = torch.from_numpy(scene.truth[0] * rng.choice([0.9, 1.0], scene.truth[0].shape)).float()
    points = RENDER.back_project(depth).flatten(0, 1)
    found = support(points, scene.views[0].T_cw, others, RENDER).view_as(depth).numpy()
    expected = slow_support(depth, scene.views[0].T_cw, others, RENDER)
    assert expected.min() < -1
    assert expected.max() > 1
    # Some ratios are at a limit by one rounding.
    assert (np.abs(found - expected) < 1e-3).mean() > 0.998


def grown(truth, pixels=2):
    """A depth map whose ball is so many pixels too large, and where."""
    truth, side = torch.from_numpy(truth), 2 * pixels + 1
    ball = (truth < 2.1)[None, None].float()
    fringe = (max_pool2d(ball, side, 1, pixels) > ball)[0, 0]
    nearest = max_pool2d(ball / truth, side, 1, pixels)[0, 0]
    return torch.where(fringe, 1 / nearest.clamp(min=1e-6), truth).numpy(), fringe


def test_a_ball_that_has_grown_in_all_views_gives_back_the_wall():
    render = LARGE.resized(192, 144)
    scene = make_scene(0, LARGE, render)
    depths = [grown(truth) for truth in scene.truth]
    engine, truth = CpuDepthEngine(render, LARGE, 8), torch.from_numpy(scene.truth[0])
    own, fringe = dense(depths[0][0]), depths[0][1]
    others = [
        (view, PosedDepth(view.T_cw, dense(depth)))
        for view, (depth, _) in zip(scene.views[1:], depths[1:], strict=True)
    ]
    found = on_their_sides(engine, scene.views[0], own, others, render)
    wrong = lambda z, where: float(((z / truth - 1).abs() > 0.05)[where].float().mean())  # noqa: E731
    assert wrong(own.depth, fringe) > 0.95
    assert wrong(found.depth, fringe) < 0.35
    assert wrong(found.depth, truth < 2.1) < 0.03
    moved = found.depth != own.depth
    assert (found.confidence[moved] == MOVED_CONFIDENCE).all()
    assert torch.equal(found.confidence[~moved], own.confidence[~moved])


def test_nothing_moves_in_the_sky_or_without_others_and_normals_of_what_moved_go():
    render = LARGE.resized(192, 144)
    scene = make_scene(0, LARGE, render)
    depth, fringe = grown(scene.truth[0])
    up = torch.zeros(*depth.shape, 3)
    up[..., 2] = -1
    sky = torch.zeros(depth.shape, dtype=torch.bool)
    sky[:72] = True
    own = dense(depth)
    own = DenseDepth(own.depth, own.confidence, own.median, normal=up, sky=sky)
    engine = CpuDepthEngine(render, LARGE, 8)
    assert on_their_sides(engine, scene.views[0], own, [], render) is own
    others = [
        (view, PosedDepth(view.T_cw, dense(truth)))
        for view, truth in zip(scene.views[1:], scene.truth[1:], strict=True)
    ]
    found = on_their_sides(engine, scene.views[0], own, others, render)
    moved = found.depth != own.depth
    assert moved[fringe & ~sky].float().mean() > 0.5
    assert not moved[sky].any()
    assert not found.normal[moved].any()
    assert torch.equal(found.normal[~moved], up[~moved])


def test_what_is_right_stays():
    scene = make_scene(0, WORKING, RENDER)
    others = [
        (view, PosedDepth(view.T_cw, dense(truth)))
        for view, truth in zip(scene.views[1:], scene.truth[1:], strict=True)
    ]
    engine = CpuDepthEngine(RENDER, WORKING, 8)
    found = on_their_sides(engine, scene.views[0], dense(scene.truth[0]), others, RENDER)
    assert float((found.depth.numpy() != scene.truth[0]).mean()) < 4e-3
