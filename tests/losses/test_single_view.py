"""Single-view terms: values by hand, gradients by finite differences, bad input."""

import math

import numpy as np
import pytest
import torch

from geogs.config import LossAblation, LossConfig
from geogs.geometry.camera import Camera
from geogs.losses.single_view import MIN_ALPHA, OUTSIDE, ViewConstants, edge_strength, gradient_norm
from loss_scenes import ALL_TERMS, CAMERA, random_view
from oracles.single_view_reference import (
    depth_l1,
    depth_smoothness,
    distortion,
    normal_consistency,
    normal_l1,
    opacity,
    silhouette,
    single_view_loss,
)


def plane_depth(normal: torch.Tensor, distance: float, camera: Camera) -> torch.Tensor:
    """Depth of the plane n.X = -distance, whose normal faces the camera."""
    return -distance / (camera.rays(torch.float64) @ normal)


def test_normal_consistency_is_zero_on_a_plane_and_two_against_it() -> None:
    n = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, -1.0]).double(), dim=0)
    depth = plane_depth(n, 2.0, CAMERA)
    edge = torch.zeros_like(depth)
    # The blend is shorter than 1; normalising it must make up for that.
    normals = (0.6 * n).expand(*depth.shape, 3)
    loss, mask = normal_consistency(depth, normals, edge, CAMERA)
    assert int(mask.sum()) == 10 * 8
    assert loss.abs().max() < 1e-5
    against, _ = normal_consistency(depth, -normals, edge, CAMERA)
    torch.testing.assert_close(against[mask], torch.full((80,), 2.0).double(), atol=1e-5, rtol=0)
    halved, _ = normal_consistency(depth, -normals, edge + 0.75, CAMERA)
    torch.testing.assert_close(halved, 0.25 * against)


def test_edge_strength_spans_zero_to_one_and_survives_a_constant_image() -> None:
    image = torch.rand(9, 11, 3, generator=torch.Generator().manual_seed(0))
    g = edge_strength(image)
    assert g[1:-1, 1:-1].min() == 0
    assert g[1:-1, 1:-1].max() == 1
    assert (g[0] == 1).all()
    assert (g[:, -1] == 1).all()
    flat = edge_strength(torch.full((9, 11, 3), 0.4))
    assert (flat[1:-1, 1:-1] == 0).all()


@pytest.mark.parametrize(("contrast", "eta"), [(0.3, 10.0), (0.15, 10.0), (0.05, 10.0)])
def test_depth_smoothness_second_term_rewards_a_step_of_known_size(
    contrast: float, eta: float
) -> None:
    """The printed loss is least at max(0, |grad I| + ln(eta |grad I|) / eta), not at 0."""
    steps = torch.linspace(0, 0.6, 601, dtype=torch.float64)
    losses = []
    for step in steps:
        depth = torch.ones(3, 2, dtype=torch.float64)
        depth[2, 0] += step
        image = torch.zeros_like(depth)
        image[1, 0] = contrast
        loss, mask = depth_smoothness(depth, image, eta)
        assert mask[1, 0]
        losses.append(loss[1, 0])
    best = float(steps[int(torch.stack(losses).argmin())])
    expected = max(0.0, contrast + math.log(eta * contrast) / eta)
    assert best == pytest.approx(expected, abs=2e-3)


def test_depth_smoothness_has_no_unit_and_one_term_on_request() -> None:
    maps, view = random_view(1)
    depth, contrast = maps[0], view.image_gradient.double()
    small, _ = depth_smoothness(depth, contrast, reward_edges=False)
    large, _ = depth_smoothness(100 * depth, contrast, reward_edges=False)
    torch.testing.assert_close(small, large)
    step = gradient_norm(depth / depth.median())
    torch.testing.assert_close(small[:-1, :-1], (step * torch.exp(-10 * contrast))[:-1, :-1])


def test_depth_and_normal_l1_and_opacity_by_hand() -> None:
    depth = torch.tensor([[2.0, 3.0, 0.0, 1.0]])
    prior = torch.tensor([[4.0, 2.0, 1.0, 0.0]])
    confidence = torch.tensor([[1.0, 0.5, 1.0, 1.0]])
    loss, mask = depth_l1(depth, prior, confidence)
    assert loss.tolist() == [[0.5, 0.25, 0.0, 0.0]]
    assert mask.tolist() == [[True, True, False, False]]
    assert depth_l1(depth, prior, relative=False)[0].tolist() == [[2.0, 1.0, 0.0, 0.0]]

    normal = torch.tensor([[[0.0, 0.0, -0.5], [0.0, -0.5, 0.0]]])
    target = torch.tensor([[[0.0, 0.6, -0.8], [0.0, 0.0, 0.0]]])
    loss, mask = normal_l1(normal, target, torch.ones(1, 2, dtype=torch.bool))
    assert loss[0, 0] == pytest.approx(0.8, abs=1e-5)
    assert mask.tolist() == [[True, False]]

    seen = torch.tensor([[True, False]])
    assert opacity(torch.tensor([[0.25, 0.5]]), seen)[0].tolist() == [[0.75, 0.0]]
    assert distortion(torch.tensor([[0.5, 7.0]]), seen, 2.0)[0].tolist() == [[0.25, 0.0]]


def test_outside_a_mask_only_the_silhouette_counts() -> None:
    maps, view = random_view(5)
    outside = view.prior_depth < 0
    assert 0 < int(outside.sum()) < outside.numel()
    leaves = [m.clone().requires_grad_() for m in maps]
    single_view_loss(*leaves, view, ALL_TERMS, 1.7).backward()
    depth, normal, alpha, spread = (m.grad for m in leaves)
    assert (depth[outside] == 0).all()
    assert (normal[outside] == 0).all()
    assert (spread[outside] == 0).all()
    pixels = outside.numel()
    expected = torch.where(outside, ALL_TERMS.silhouette_weight, -ALL_TERMS.opacity_weight) / pixels
    torch.testing.assert_close(alpha, expected.double(), rtol=1e-6, atol=0)
    seen = torch.tensor([[0.25, 0.5, float("nan")]])
    assert silhouette(seen, torch.tensor([[True, False, True]]))[0].tolist() == [[0.25, 0.0, 0.0]]


def test_gradients_match_finite_differences() -> None:
    maps, view = random_view(2)
    seen = maps[0][(maps[2] > MIN_ALPHA) & (view.prior_depth >= 0)]
    median = maps[0] == seen.median()  # constant in the loss, so it must not be moved
    fixed = maps[0].clone()
    maps = [m.requires_grad_() for m in maps]

    def loss(depth: torch.Tensor, *others: torch.Tensor) -> torch.Tensor:
        depth = torch.where(median, fixed, depth)
        return single_view_loss(depth, *others, view, ALL_TERMS, 1.7)

    # L_1 has kinks; random data lies far from them compared to the step.
    assert torch.autograd.gradcheck(loss, maps, eps=1e-7, atol=1e-7, rtol=1e-4, fast_mode=True)


def test_the_loss_does_not_depend_on_the_scale_of_the_map() -> None:
    maps, view = random_view(3)
    scaled = ViewConstants(
        CAMERA, view.edge, view.image_gradient, 5 * view.prior_depth.clamp(min=0)
        + view.prior_depth.clamp(max=0), view.confidence,
        view.prior_normal,
    )  # fmt: skip
    one = single_view_loss(*maps, view, ALL_TERMS, 1.7)
    five = single_view_loss(5 * maps[0], *maps[1:3], 5 * maps[3], scaled, ALL_TERMS, 5 * 1.7)
    assert float(five) == pytest.approx(float(one), rel=1e-6)


@pytest.mark.parametrize("bad", ["nothing", "nan"])
def test_views_without_depth_give_no_loss_and_no_gradient(bad: str) -> None:
    maps, view = random_view(4)
    value = 0.0 if bad == "nothing" else math.nan
    maps = [torch.full_like(m, value).requires_grad_() for m in maps]
    config = LossConfig(
        normal_weight=0.1,
        smoothness_weight=0.05,
        ablation=LossAblation(smoothness_rewards_edges=True),
        opacity_weight=0.0,
        silhouette_weight=0.0,
    )
    loss = single_view_loss(*maps, view, config, 1.0)
    loss.backward()
    assert float(loss.detach()) == 0
    for m in maps:
        assert (m.grad == 0).all()


def test_half_the_resolution_knows_planes_but_nothing_across_an_edge() -> None:
    camera = Camera(fx=30.0, fy=31.0, cx=11.2, cy=9.7, width=24, height=20)
    near, far = ((torch.tensor([0.3, -0.2, -1.0]).double(), k) for k in (2.0, 4.0))
    depth = plane_depth(*near, camera)
    depth[:, 13:] = plane_depth(*far, camera)[:, 13:]
    depth[:4], depth[-2:, :5] = OUTSIDE, 0.0
    normals = torch.zeros(20, 24, 3)
    normals[..., 2] = -1.0
    normals[:, 14, 2] = 1.0  # with the column beside it the mean is none
    confidence = torch.full((20, 24), 0.4)
    image = np.zeros((20, 24, 3), np.uint8)
    half = ViewConstants.prepare(image, camera, depth.float(), confidence, normals).halved
    assert (half.camera.width, half.camera.height) == (12, 10)
    assert half.camera.fx == 15.0
    assert half.camera.cx == pytest.approx((11.2 + 0.5) / 2 - 0.5)
    expected = plane_depth(*near, half.camera)
    expected[:, 7:] = plane_depth(*far, half.camera)[:, 7:]
    expected[:, 6] = 0.0  # of both
    expected[:2], expected[-1, :3] = OUTSIDE, 0.0
    assert half.prior_depth.numpy() == pytest.approx(expected.numpy(), rel=1e-5)
    weight = torch.where(expected > 0, 0.4, 0.0)
    assert half.confidence.numpy() == pytest.approx(weight.numpy(), rel=1e-6)
    assert half.prior_normal is not None
    assert not half.prior_normal[:, 7].any()
    torch.testing.assert_close(half.prior_normal[:, :7], normals[::2, :14:2])
