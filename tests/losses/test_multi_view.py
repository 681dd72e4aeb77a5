"""Warping through a depth: an exact textured plane, masks, and gradients to depth and poses."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geogs.config import LossConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.lie import retract, se3_exp, se3_inverse
from geogs.losses.exposure import USUAL_NOISE
from geogs.losses.kernel_settings import MIN_COVERAGE
from geogs.losses.multi_view import PhotoView, enlarge_depth
from oracles.multi_view_reference import multi_view_loss, occlusion_mask, warp
from oracles.photometric_reference import ssim

CAMERA = Camera(50.0, 52.0, 23.3, 19.1, 48, 40)
NORMAL, DISTANCE = torch.tensor([0.2, -0.1, -1.0]).double(), 2.0
REFERENCE = se3_exp(torch.tensor([0.05, 0.02, 0.1, 0.02, -0.03, 0.01]).double())
TARGET = se3_exp(torch.tensor([-0.1, 0.05, 0.02, -0.02, 0.03, 0.04]).double())


def plane_view(T_cw: torch.Tensor, camera: Camera = CAMERA) -> tuple[torch.Tensor, torch.Tensor]:
    """Exact depth and smooth grey image of the plane n.X + distance = 0 of the world."""
    T_wc = se3_inverse(T_cw)
    rays = camera.rays(torch.float64) @ T_wc[:3, :3].T
    depth = -(DISTANCE + T_wc[:3, 3] @ NORMAL) / (rays @ NORMAL)
    points = T_wc[:3, 3] + depth[..., None] * rays
    x, y = 9 * points[..., 0], 9 * points[..., 1]
    grey = 0.5 + 0.2 * torch.sin(x + 0.3 * y) + 0.2 * torch.cos(0.4 * x - y)
    return depth, grey


def views(camera: Camera = CAMERA) -> tuple[torch.Tensor, PhotoView, PhotoView, torch.Tensor]:
    """Reference depth, both views, target depth."""
    depth, a = plane_view(REFERENCE, camera)
    seen, b = plane_view(TARGET, camera)
    reference, target = (PhotoView.of(grey[None], camera, T) for grey, T in
                         ((a, REFERENCE), (b, TARGET)))  # fmt: skip
    return depth, reference, target, seen


def test_the_true_depth_warps_the_target_onto_the_reference() -> None:
    depth, reference, target, seen = views()
    warped = warp(target.grey, depth, CAMERA, CAMERA, REFERENCE, TARGET)
    assert 0.7 < warped.in_view.double().mean() < 1
    error = (warped.image - reference.grey)[warped.in_view].abs()
    assert error.max() < 0.01  # what bilinear interpolation leaves
    assert (warped.image[~warped.in_view] == 0).all()
    assert occlusion_mask(warped, seen, CAMERA).sum() >= 0.99 * warped.in_view.sum()

    loss = multi_view_loss(depth, reference, target, seen, LossConfig())
    for wrong in (0.97, 1.03):
        worse = multi_view_loss(wrong * depth, reference, target, seen, LossConfig())
        assert worse > 3 * loss


def test_hidden_and_outside_pixels_are_masked() -> None:
    depth, _, target, seen = views()
    depth[3, 4] = 0
    depth[5, 6] = -1
    warped = warp(target.grey, depth, CAMERA, CAMERA, REFERENCE, TARGET)
    assert not warped.in_view[3, 4]
    assert not warped.in_view[5, 6]
    inside = (warped.pixels >= 0).all(-1) & (warped.pixels <= torch.tensor([47, 39])).all(-1)
    assert (warped.in_view == inside & (depth > 0)).all()
    for factor, expected in ((0.96, True), (1.04, True), (0.94, False), (1.06, False)):
        mask = occlusion_mask(warped, factor * seen, CAMERA, 0.05)
        assert bool(mask.any()) == expected
    unknown = seen.clone()
    unknown[:, 20:] = 0
    mask = occlusion_mask(warped, unknown, CAMERA)
    assert mask.any()
    assert (warped.pixels[mask][:, 0] <= 19).all()
    behind = REFERENCE.clone()
    behind[2, 3] -= 10
    assert not warp(target.grey, depth, CAMERA, CAMERA, REFERENCE, behind).in_view.any()


def test_occlusion_accepts_a_depth_of_another_size() -> None:
    big = CAMERA.resized(96, 80)
    depth, _, target, _ = views(big)
    small, _ = plane_view(TARGET, CAMERA)
    warped = warp(target.grey, depth, big, big, REFERENCE, TARGET)
    assert occlusion_mask(warped, small, big, 0.005).sum() >= 0.99 * warped.in_view.sum()


def test_enlarged_depth_is_exact_where_linear_and_keeps_holes() -> None:
    rows, columns = torch.meshgrid(torch.arange(10), torch.arange(12), indexing="ij")
    depth = (2 + 0.1 * columns - 0.05 * rows).double()
    depth[4, 5] = float("nan")
    big = enlarge_depth(depth, 20, 24)
    at_x = (torch.arange(24) + 0.5) / 2 - 0.5
    at_y = (torch.arange(20) + 0.5) / 2 - 0.5
    expected = 2 + 0.1 * at_x[None] - 0.05 * at_y[:, None]
    known = big > 0
    assert int((~known).sum()) == 16  # the 4x4 pixels that draw on the hole
    assert not known[7:11, 9:13].any()
    inner = torch.zeros_like(known)
    inner[1:-1, 1:-1] = True
    torch.testing.assert_close(big[known & inner], expected.double()[known & inner])


def test_gradients_match_finite_differences() -> None:
    depth, _ = plane_view(REFERENCE, CAMERA.resized(12, 10))
    _, reference, target, seen = views()
    noise = np.random.default_rng(1).random((10, 12))
    depth = (depth * torch.from_numpy(1 + 0.01 * noise)).requires_grad_()
    config = replace(LossConfig(), ssim_weight=0.3)

    def loss(d: torch.Tensor, xi_r: torch.Tensor, xi_t: torch.Tensor) -> torch.Tensor:
        moved = reference.at(retract(xi_r, REFERENCE)), target.at(retract(xi_t, TARGET))
        # Without the depth test: its mask may flip within the step of the difference.
        return multi_view_loss(d, *moved, None, config)

    still = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    inputs = (depth, still, still.detach().clone().requires_grad_())
    assert torch.autograd.gradcheck(loss, inputs, eps=1e-8, atol=1e-6, rtol=1e-3, fast_mode=True)
    value = multi_view_loss(depth, reference, target, seen, config)
    (gradient,) = torch.autograd.grad(value, depth)
    assert gradient.abs().max() > 0


@pytest.mark.parametrize("value", [0.0, float("nan"), -1.0])
def test_a_view_without_depth_gives_no_loss_and_no_gradient(value: float) -> None:
    _, reference, target, seen = views()
    depth = torch.full((20, 24), value, dtype=torch.float64, requires_grad=True)
    loss = multi_view_loss(depth, reference, target, seen, LossConfig())
    loss.backward()
    assert float(loss.detach()) == 0
    assert (depth.grad == 0).all()


def test_colour_is_compared_as_printed_and_correlation_in_grey() -> None:
    """L_1 and L_ssim of images with three channels; NCC of their grey; tau is relative."""
    depth, reference, target, seen = views()
    gains = torch.tensor([1.0, 0.7, 0.4]).double()[:, None, None]
    reference, target = (
        replace(v, colours=gains * v.grey + 0.05 * gains.flip(0)) for v in (reference, target)
    )
    config = LossConfig(
        l1_weight=0.8, l1_huber=0.0, l1_cut=10.0, photo_texture=0.0, ssim_weight=0.2,
        ncc_weight=0.15, colour=True, occlusion_ratio=0.05,
    )  # fmt: skip
    wrong = 1.02 * depth
    warped = warp(target.grey, wrong, CAMERA, CAMERA, REFERENCE, TARGET)
    mask = occlusion_mask(warped, seen, CAMERA, 0.05)
    assert target.colours is not None
    assert reference.colours is not None
    channels = [reference.colours.permute(1, 2, 0), target.colours.permute(1, 2, 0)]
    other = warp(channels[1], wrong, CAMERA, CAMERA, REFERENCE, TARGET).image
    l1 = (channels[0] - other).abs().mean(-1)[mask].sum()
    structure, _ = ssim(channels[0], other, mask, MIN_COVERAGE)
    grey = replace(config, l1_weight=0.0, ssim_weight=0.0, colour=False)
    expected = (0.8 * l1 + 0.2 * structure.sum()) / depth.numel()
    expected = expected + multi_view_loss(wrong, reference, target, seen, grey)
    got = multi_view_loss(wrong, reference, target, seen, config)
    assert float(got) == pytest.approx(float(expected), rel=1e-9)


def test_photo_view_is_grey_smoothed_and_of_the_camera_size() -> None:
    image = np.zeros((80, 96, 3), np.uint8)
    image[:, 48:] = (255, 0, 0)
    sharp = PhotoView.prepare(image, CAMERA, REFERENCE, blur=0.0)
    assert sharp.grey.shape == (40, 48)
    assert float(sharp.grey.max()) == pytest.approx(0.299, abs=2e-3)
    soft = PhotoView.prepare(image, CAMERA, REFERENCE)
    assert 0 < soft.grey[5, 23] < soft.grey[5, 24] < sharp.grey.max()
    with pytest.raises(InputError, match="16"):
        PhotoView.prepare(image, CAMERA.resized(12, 40), REFERENCE)


def test_texture_is_the_variance_over_the_noise() -> None:
    grey = torch.from_numpy(np.random.default_rng(4).random((18, 21)).astype(np.float32))
    view = PhotoView.of(torch.stack([grey, grey, grey, grey]), CAMERA, REFERENCE)
    around = torch.nn.functional.pad(grey[None], (2, 2, 2, 2), mode="reflect")[0]
    slow = torch.stack(
        [around[y : y + 5, x : x + 5].var(correction=0) for y in range(18) for x in range(21)]
    )
    slow = slow.reshape(18, 21) / USUAL_NOISE
    torch.testing.assert_close(view.texture, slow, rtol=1e-4, atol=0.01)
    brighter = view.with_exposure(torch.tensor([1.5, 0.2, 4 * USUAL_NOISE]))
    assert brighter.colours is not None
    for plane in (brighter.grey, *brighter.colours):
        torch.testing.assert_close(plane, 1.5 * grey + 0.2)
    again = PhotoView.of(brighter.planes, CAMERA, REFERENCE)
    torch.testing.assert_close(4 * brighter.texture, again.texture, rtol=1e-4, atol=0.01)


def test_bare_pixels_count_less() -> None:
    depth, reference, target, _ = views()
    wrong = 1.02 * depth
    mask = warp(target.grey, wrong, CAMERA, CAMERA, REFERENCE, TARGET).in_view
    v = float(reference.texture[mask].median())
    plain = LossConfig(photo_texture=0.0)
    everywhere = multi_view_loss(wrong, reference, target, None, plain)
    weighed = multi_view_loss(wrong, reference, target, None, replace(plain, photo_texture=v))
    assert 0.3 * everywhere < weighed < 0.7 * everywhere
    bare = replace(reference, texture=torch.zeros_like(reference.texture))
    assert multi_view_loss(wrong, bare, target, None, plain) == everywhere
    assert multi_view_loss(wrong, bare, target, None, replace(plain, photo_texture=v)) == 0
