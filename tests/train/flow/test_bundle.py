"""The differentiable bundle adjustment against the tracker's, finite differences and the truth."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bundle_scenes import CAMERA, disturbed, scene
from geogs.bundle.dense import DenseBundle
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import project, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.geometry.camera import Camera
from geogs.geometry.lie import retract, se3_inverse
from geogs.world.grid import SampleGrid
from geogs_train.flow.bundle import (
    ClipBundleOptions,
    ClipCameras,
    ClipEdges,
    ClipMatches,
    ClipState,
    adjust,
    reproject,
)
from geogs_train.flow.bundle_course import true_state
from tracking_scenes import CAMERA as ROOM
from tracking_scenes import pose, render

AS_TRACKER = ClipBundleOptions(1, 2, 1e-4, 1e-2, 1e-3, 1e-8)
"""With the damping of the tracker's solver."""


OTHER = Camera(fx=90.0, fy=85.0, cx=41.0, cy=27.0, width=80, height=60)


def as_clip(
    problem: BundleProblem, camera: Camera = CAMERA
) -> tuple[ClipCameras, ClipState, ClipEdges, ClipMatches]:
    intrinsics = torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy]])
    return (
        ClipCameras(intrinsics, SampleGrid(camera).pixels),
        ClipState(problem.T_cw[None], problem.inverse_depth[None]),
        ClipEdges(problem.source, problem.target),
        ClipMatches(problem.pixels[None], problem.weight[None]),
    )


def batched(
    a: tuple[ClipCameras, ClipState, ClipEdges, ClipMatches],
    b: tuple[ClipCameras, ClipState, ClipEdges, ClipMatches],
) -> tuple[ClipCameras, ClipState, ClipEdges, ClipMatches]:
    def cat(x, y):
        return torch.cat([x, y])

    return (
        ClipCameras(cat(a[0].intrinsics, b[0].intrinsics), a[0].cells),
        ClipState(cat(a[1].T_cw, b[1].T_cw), cat(a[1].inverse_depth, b[1].inverse_depth)),
        a[2],
        ClipMatches(*(cat(getattr(a[3], n), getattr(b[3], n)) for n in a[3].__dict__)),
    )


def test_a_step_is_that_of_the_tracker():
    """Of both clips of a batch, which are seen through different cameras."""
    cameras, problems = (CAMERA, OTHER), []
    for seed, camera in enumerate(cameras):
        _, problem = scene(seed=seed)
        T = relative_motion(problem.T_cw, problem.source, problem.target)
        d = problem.inverse_depth[problem.source]
        pixels = project(camera, SampleGrid(camera).rays, T, d).pixels
        problems.append(disturbed(replace(problem, pixels=pixels), 0.02, 0.05))
    clips = [as_clip(*pair) for pair in zip(problems, cameras, strict=True)]
    found = adjust(*batched(*clips), AS_TRACKER)
    for n, (problem, camera) in enumerate(zip(problems, cameras, strict=True)):
        expected = DenseBundle(SampleGrid(camera)).solve(problem, BundleOptions(1, huber=1e9))
        assert float((expected.T_cw - problem.T_cw).abs().max()) > 0.01
        torch.testing.assert_close(found.T_cw[n], expected.T_cw, rtol=0, atol=2e-5)
        torch.testing.assert_close(
            found.inverse_depth[n], expected.inverse_depth, rtol=0, atol=5e-5
        )


def test_it_converges_to_the_truth():
    _, truth = scene()
    clip = as_clip(disturbed(truth, 0.03, 0.1))
    found = adjust(*clip, replace(AS_TRACKER, iterations=12))
    centres = se3_inverse(found.T_cw[0])[:, :3, 3] - se3_inverse(truth.T_cw)[:, :3, 3]
    assert float(centres.norm(dim=1).max()) < 1e-4
    assert float((found.inverse_depth[0] / truth.inverse_depth - 1).abs().max()) < 1e-3
    assert torch.equal(found.T_cw[0, :2], truth.T_cw[:2])
    error = reproject(clip[0], found, clip[2]).pixels - clip[3].pixels
    assert float(error.abs().max()) < 0.01


def tiny() -> tuple[ClipCameras, ClipState, ClipEdges, ClipMatches]:
    """Two clips of four views with six cells, in float64."""
    g = torch.Generator().manual_seed(1)

    def rand(*shape):
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    cameras = ClipCameras(torch.tensor([[5.0, 5.2, 3.0, 2.5], [6.0, 5.5, 3.2, 2.2]]).double(),
                          6 * rand(6, 2))  # fmt: skip
    eye = torch.eye(4, dtype=torch.float64).expand(2, 4, 4, 4)
    T = retract(0.2 * (rand(2, 4, 6) - 0.5), eye)
    state = ClipState(T, 0.5 + 0.5 * rand(2, 4, 6))
    pairs = [(i, j) for i in range(4) for j in range(4) if 0 < abs(i - j) <= 2]
    edges = ClipEdges(*(torch.tensor([p[k] for p in pairs]) for k in (0, 1)))
    exact = reproject(cameras, state, edges).pixels
    pixels = exact + 0.2 * (rand(*exact.shape) - 0.5)
    return cameras, state, edges, ClipMatches(pixels, 0.2 + rand(*exact.shape))


def test_gradients_match_finite_differences():
    """Through two steps, to matches, weights and the state that came in."""
    cameras, state, edges, matches = tiny()
    options = ClipBundleOptions(2, damping_floor=1e-3)

    def solved(xi, inverse_depth, pixels, weight):
        start = ClipState(retract(xi, state.T_cw), inverse_depth)
        out = adjust(cameras, start, edges, ClipMatches(pixels, weight), options)
        return out.T_cw[..., :3, :], out.inverse_depth

    inputs = [
        torch.zeros(2, 4, 6, dtype=torch.float64),
        state.inverse_depth,
        matches.pixels,
        matches.weight,
    ]
    for x in inputs:
        x.requires_grad_()
    moved = solved(*inputs)
    assert float((moved[0].detach() - state.T_cw[..., :3, :]).abs().max()) > 0.003
    # Along random directions, one for each input and output.
    assert torch.autograd.gradcheck(solved, inputs, eps=1e-6, atol=1e-7, rtol=1e-5, fast_mode=True)


def test_a_clip_without_a_solution_keeps_its_poses_and_its_neighbour_is_right():
    cameras, state, edges, matches = tiny()
    expected = adjust(cameras, state, edges, matches)
    broken = matches.pixels.clone()
    broken[0, 0, 0] = torch.nan
    found = adjust(cameras, state, edges, replace(matches, pixels=broken))
    assert torch.equal(found.T_cw[0], state.T_cw[0])
    torch.testing.assert_close(found.T_cw[1], expected.T_cw[1])
    torch.testing.assert_close(found.inverse_depth[1], expected.inverse_depth[1])


def test_the_true_state_is_what_the_views_show():
    """Cells fall on points of the next view that are as far away as they are themselves."""
    camera = ROOM.resized(64, 48)
    poses = [pose(0.0), pose(0.25, 0.04)]
    depth = torch.from_numpy(np.stack([render(T, camera)[1] for T in poses])).float()
    truth = true_state(torch.from_numpy(np.linalg.inv(np.stack(poses)))[None], depth[None])
    assert float(truth.inverse_depth.median()) == pytest.approx(1)
    intrinsics = torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy]])
    cameras = ClipCameras(intrinsics, SampleGrid(camera).pixels)
    torch.testing.assert_close(cameras.rays[0], SampleGrid(camera).rays, rtol=0, atol=1e-6)
    there = reproject(cameras, truth, ClipEdges(torch.tensor([0]), torch.tensor([1])))
    x, y = there.pixels[0, 0].round().long().unbind(-1)
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    expected = depth[1][y[inside], x[inside]]
    close = (depth[0, 4:-3:8, 4:-3:8].reshape(-1) * there.z[0, 0])[inside] / expected - 1
    assert float(inside.float().mean()) > 0.8
    assert float((close.abs() < 0.03).double().mean()) > 0.9  # the rest is hidden there
