"""The compiled losses against the plain ones: value, gradients, threads, bad input."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from geogs.config import LossAblation, LossConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.losses import kernel_settings
from geogs.losses.cpu.fused import fused_multi_view, fused_single_view
from geogs.losses.exposure import USUAL_NOISE
from geogs.losses.multi_view import PhotoView
from loss_scenes import ALL_TERMS, random_view
from oracles import multi_view_reference
from oracles.multi_view_reference import multi_view_loss
from oracles.single_view_reference import single_view_loss

SMALL = Camera(70.0, 71.0, 39.3, 30.2, 80, 60)
BIG = SMALL.resized(160, 120)


def relative(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a.double() - b.double()).norm() / b.double().norm())


def leaves(*tensors: torch.Tensor) -> list[torch.Tensor]:
    return [t.detach().clone().requires_grad_() for t in tensors]


SINGLE = {
    "default": LossConfig(),
    "all": ALL_TERMS,
    "absolute": replace(ALL_TERMS, ablation=LossAblation(depth_relative=False)),
    "depth only": LossConfig(
        normal_consistency_weight=0.0, opacity_weight=0.0, distortion_weight=0.0
    ),
}


@pytest.mark.parametrize("name", SINGLE)
def test_single_view_matches_the_plain_loss(name: str) -> None:
    maps, view = random_view(11, SMALL)
    maps[0][20:24, 30:40] = 0
    maps[0][40, 50] = float("nan")
    maps[3][10, 10] = float("nan")
    fast, slow = leaves(*(m.float() for m in maps)), leaves(*maps)
    a = fused_single_view(*fast, view, SINGLE[name], 1.7)
    b = single_view_loss(*slow, view, SINGLE[name], 1.7)
    assert float(a.detach()) == pytest.approx(float(b.detach()), rel=1e-5)
    (3 * a).backward()
    (3 * b).backward()
    for f, s in zip(fast, slow, strict=True):
        if s.grad is None or s.grad.norm() == 0:
            assert (f.grad == 0).all()
        else:
            assert relative(f.grad, s.grad) < 2e-4


def photo_case(seed: int) -> tuple[torch.Tensor, PhotoView, PhotoView, torch.Tensor]:
    """A wavy surface with holes, two noisy textured images, a target depth that hides a part."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.random((120, 160, 3)), (0, 0), 2.5)
    texture = np.clip(127 + 2000 * (noise - 0.5), 0, 255)
    other = np.clip(1.05 * texture + 3 * rng.normal(size=texture.shape), 0, 255)
    rows, columns = torch.meshgrid(torch.arange(60), torch.arange(80), indexing="ij")
    depth = 2 + 0.2 * torch.sin(columns / 12) + 0.1 * torch.cos(rows / 9)
    depth[12:16, 20:26] = 0
    depth[30, 40] = float("nan")
    near = se3_exp(torch.tensor([0.02, -0.01, 0.01, 0.002, 0.003, -0.01]).double())
    images = [x.astype(np.uint8) for x in (texture, other)]
    reference = PhotoView.prepare(images[0], BIG, torch.eye(4).double(), with_colour=True)
    reference = reference.with_exposure(torch.tensor([1.0, 0.0, 3 * USUAL_NOISE]))
    target = PhotoView.prepare(images[1], BIG, near, with_colour=True)
    hidden = depth.clone().nan_to_num(0.0)
    hidden[40:50, 10:30] *= 0.8
    return depth, reference, target, hidden


MULTI = {
    "default": LossConfig(),
    "ncc 5": LossConfig(l1_weight=0.0, ncc_patch=5, ncc_reject=1.5),
    "l1 plain": LossConfig(ncc_weight=0.0, l1_huber=0.0, l1_cut=1.0, photo_texture=0.0),
    "l1 by texture": LossConfig(ncc_weight=0.0, photo_texture=200.0),
    "ssim": LossConfig(ssim_weight=0.4),
    "colour": LossConfig(
        ssim_weight=0.4, colour=True, occlusion_ratio=0.05, l1_huber=0.0, l1_cut=1.0
    ),
}


@pytest.mark.parametrize("with_target_depth", [True, False])
@pytest.mark.parametrize("name", MULTI)
def test_multi_view_matches_the_plain_loss(name: str, with_target_depth: bool) -> None:
    depth, reference, target, hidden = photo_case(5)
    config, seen = MULTI[name], hidden if with_target_depth else None
    gradients, values = [], []
    for loss, dtype in ((fused_multi_view, torch.float32), (multi_view_loss, torch.float64)):
        d, T_r, T_t = leaves(depth.to(dtype), reference.T_cw, target.T_cw)
        value = 2 * loss(d, reference.at(T_r), target.at(T_t), seen, config)
        value.backward()
        values.append(float(value.detach()))
        gradients.append((d.grad, T_r.grad, T_t.grad))
    assert values[0] == pytest.approx(values[1], rel=1e-4)
    for fast, slow in zip(*gradients, strict=True):
        assert relative(fast, slow) < 2e-3
    assert gradients[0][0][13, 22] == 0
    assert gradients[0][0][30, 40] == 0


def test_the_photometric_size_may_equal_the_render_size_or_be_no_multiple(monkeypatch) -> None:
    depth, reference, target, hidden = photo_case(6)
    full = torch.nn.functional.interpolate(depth.nan_to_num(0.0)[None, None], (120, 160))[0, 0]
    odd = torch.nn.functional.interpolate(depth.nan_to_num(0.0)[None, None], (43, 61))[0, 0]
    config = LossConfig(
        l1_weight=1.0, l1_huber=0.8, l1_cut=0.2, ncc_patch=7, photo_texture=0.3
    )  # fmt: skip
    for module in (multi_view_reference, kernel_settings):
        monkeypatch.setattr(module, "NCC_MIN_VARIANCE", 1e-4)
    for d in (full, odd):
        (fast,) = leaves(d)
        (slow,) = leaves(d.double())
        a = fused_multi_view(fast, reference, target, hidden, config)
        b = multi_view_loss(slow, reference, target, hidden, config)
        a.backward()
        b.backward()
        # In float32 a few windows fall on the other side of a threshold.
        assert float(a.detach()) == pytest.approx(float(b.detach()), rel=5e-4)
        assert relative(fast.grad, slow.grad) < 5e-3


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    maps, view = random_view(12, SMALL)
    depth, reference, target, hidden = photo_case(7)
    results = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            inputs = leaves(*(m.float() for m in maps), depth, reference.T_cw)
            single = fused_single_view(*inputs[:4], view, ALL_TERMS, 1.0)
            multi = fused_multi_view(
                inputs[4], reference.at(inputs[5]), target, hidden, LossConfig()
            )
            (single + multi).backward()
            results.append([single.detach(), multi.detach(), *(i.grad for i in inputs)])
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


@pytest.mark.parametrize("value", [0.0, float("nan"), float("inf")])
def test_views_without_depth_give_no_loss_and_no_gradient(value: float) -> None:
    maps, view = random_view(13, SMALL)
    config = replace(ALL_TERMS, opacity_weight=0.0, silhouette_weight=0.0)
    inputs = leaves(*(torch.full_like(m, value).float() for m in maps))
    _, reference, target, hidden = photo_case(8)
    loss = fused_single_view(*inputs, view, config, 1.0)
    loss = loss + fused_multi_view(inputs[0], reference, target, hidden, LossConfig())
    loss.backward()
    assert float(loss.detach()) == 0
    assert all((i.grad == 0).all() for i in inputs)
