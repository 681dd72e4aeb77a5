"""The CPU renderer against its specification, forward and backward."""

import re
from collections.abc import Callable

import numba
import numpy as np
import pytest
import torch

from geogs.geometry.camera import Camera
from geogs.geometry.lie import quaternion_multiply, se3_exp
from geogs.splat.cpu.blend import blend_disk
from geogs.splat.cpu.blend_backward import unblend_disk
from geogs.splat.cpu.layout import exp_minus
from geogs.splat.cpu.rasterize import rasterize_backward, rasterize_forward
from geogs.splat.render import render
from geogs.world.disks import DiskParameters, GaussianMap
from splat_scenes import (
    CAMERA,
    MAPS,
    SCENES,
    differentiate,
    disks_at,
    edge_on,
    held_at_the_near_plane,
    ordinary,
    pose,
    relative,
    tiny,
)


@pytest.mark.parametrize("scene", SCENES)
def test_maps_and_gradients_match_the_reference(scene: Callable[[], DiskParameters]) -> None:
    # Across a disk seen edge-on, float32 pixel offsets are coarse.
    tolerance = 1e-3 if scene is edge_on else 1e-4
    disks = scene()
    expected, gradients = differentiate(disks, CAMERA, "reference", torch.float64)
    out, found = differentiate(disks, CAMERA, "cpu", torch.float32)
    assert expected.alpha.max() > 0.03
    assert torch.equal(out.visible, expected.visible)
    for name in (*MAPS, "median_depth"):
        assert relative(getattr(out, name), getattr(expected, name)) < tolerance, name
    names = (*DiskParameters._fields, "T_cw")
    for name, a, b in zip(names, found, gradients, strict=True):
        # Disks far below a pixel show only the blur, whatever their scale.
        assert (b.norm() == 0) == (scene is tiny and name == "log_scale"), name
        assert relative(a, b) < 10 * tolerance, name


@pytest.mark.parametrize(("width", "height"), [(1, 1), (8, 64), (9, 65), (16, 16), (33, 130)])
def test_any_image_size(width: int, height: int) -> None:
    camera = Camera(fx=40.0, fy=40.0, cx=width / 2, cy=height / 2, width=width, height=height)
    disks = disks_at(100, 11, -1.5)
    expected, gradients = differentiate(disks, camera, "reference", torch.float64)
    out, found = differentiate(disks, camera, "cpu", torch.float32)
    assert out.depth.shape == (height, width)
    for name in MAPS:
        assert relative(getattr(out, name), getattr(expected, name)) < 1e-4, name
    for a, b in zip(found, gradients, strict=True):
        assert relative(a, b) < 1e-3


def test_empty_map() -> None:
    disks = GaussianMap.empty()
    out = render(disks, CAMERA, pose(), backend="cpu")
    assert out.depth.shape == (75, 45)
    assert all(getattr(out, name).abs().max() == 0 for name in MAPS)
    assert out.visible.shape == (0,)
    (out.depth.sum() + out.alpha.sum()).backward()
    assert disks.position.grad is not None
    assert disks.position.grad.shape == (0, 3)


def test_no_disk_in_view() -> None:
    disks = ordinary()
    behind = disks._replace(position=-disks.position)
    out, gradients = differentiate(behind, CAMERA, "cpu", torch.float32)
    assert out.alpha.abs().max() == 0
    assert not out.visible.any()
    assert all(g.abs().max() == 0 for g in gradients)


def test_bad_numbers_do_no_harm() -> None:
    disks = DiskParameters(*(p.clone() for p in ordinary()))
    for row, value in enumerate((torch.nan, torch.inf, -torch.inf, 1e30)):
        for group in disks[:3]:
            group[row] = value
    disks.opacity_logit[:3] = torch.nan
    disks.quaternion[5] = 0
    out, gradients = differentiate(disks, CAMERA, "cpu", torch.float32)
    assert all(torch.isfinite(getattr(out, name)).all() for name in MAPS)
    assert all(torch.isfinite(g).all() for g in gradients)
    good = [*range(6, 160)]
    kept = DiskParameters(*(p[[4, *good]] for p in disks))
    assert torch.equal(render(kept, CAMERA, pose()).depth, out.depth)


def test_tangent_gradient_follows_from_the_matrix_gradient() -> None:
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    disks, results = ordinary(), []
    for backend, dtype in (("reference", torch.float64), ("cpu", torch.float32)):
        parameters = DiskParameters(*(p.to(dtype) for p in disks))
        out = render(parameters, CAMERA, se3_exp(xi) @ pose(), backend=backend)
        loss = (out.depth.double() ** 2).sum() + out.normal[..., 2].double().sum()
        results.append(torch.autograd.grad(loss, xi)[0])
    assert relative(results[1], results[0]) < 1e-4


def plain(p: DiskParameters) -> tuple[np.ndarray, ...]:
    return tuple(t.numpy() for t in p)


def test_results_do_not_depend_on_threads() -> None:
    disks, T_cw = plain(ordinary()), pose()[:3].numpy()
    rng = np.random.default_rng(0)
    shapes = [(75, 45), (75, 45, 3), (75, 45), (75, 45)]
    weights = [rng.normal(size=s).astype(np.float32) for s in shapes]
    runs = []
    for threads in (1, 2, 2, 3):
        maps, trace = rasterize_forward(disks, CAMERA, T_cw, 0.05, threads)
        of_disks, of_pose = rasterize_backward(trace, *weights, threads)
        runs.append((*maps, *of_disks, of_pose))
    for arrays in runs[1:]:
        for array, first in zip(arrays, runs[0], strict=True):
            assert np.array_equal(array, first)


def test_renderings_can_wait_for_their_backward_pass() -> None:
    disks = DiskParameters(*(p.requires_grad_() for p in ordinary()))
    poses = [pose(), se3_exp(torch.full((6,), 0.1, dtype=torch.float64))]
    alone = [
        torch.autograd.grad(render(disks, CAMERA, T).depth.square().sum(), disks) for T in poses
    ]
    both = [render(disks, CAMERA, T) for T in poses]
    render(disks, CAMERA, torch.eye(4, dtype=torch.float64))
    for k in (1, 0):
        late = torch.autograd.grad(both[k].depth.square().sum(), disks)
        assert all(torch.equal(a, b) for a, b in zip(late, alone[k], strict=True))


def test_without_gradients_nothing_is_kept() -> None:
    disks = DiskParameters(*(p.requires_grad_() for p in ordinary()))
    expected = render(disks, CAMERA, pose())
    with torch.no_grad():
        out = render(disks, CAMERA, pose())
    assert not out.depth.requires_grad
    assert torch.equal(out.depth, expected.depth)
    _, trace = rasterize_forward(
        plain(ordinary()), CAMERA, pose()[:3].numpy(), 0.05, 1, with_trace=False
    )
    assert trace.saved.size == 0


def test_changing_the_disks_before_the_backward_pass_is_noticed() -> None:
    disks = DiskParameters(*(p.requires_grad_() for p in ordinary()))
    out = render(disks, CAMERA, pose())
    with torch.no_grad():
        disks.position.add_(0.1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.depth.sum().backward()


def test_near_is_a_bound_of_depth() -> None:
    disks = disks_at(200, 12, -0.5)
    out = render(disks, CAMERA, pose(), near=2.5)
    expected = render(
        DiskParameters(*(p.double() for p in disks)), CAMERA, pose(), backend="reference", near=2.5
    )
    assert relative(out.depth, expected.depth) < 1e-4
    assert out.depth[out.alpha > 0].min() >= 2.5
    assert not torch.equal(out.visible, render(disks, CAMERA, pose()).visible)


def test_hits_held_at_the_near_plane_move_with_the_centre() -> None:
    expected = held_at_the_near_plane("reference", torch.float64, "cpu")
    for a, b in zip(held_at_the_near_plane("cpu", torch.float32, "cpu"), expected, strict=True):
        assert relative(a, b) < 1e-3


def test_wrong_dtype_is_refused() -> None:
    disks = DiskParameters(*(p.double() for p in ordinary()))
    with pytest.raises(ValueError, match="float32"):
        render(disks, CAMERA, pose(), backend="cpu")
    assert render(disks, CAMERA, pose()).depth.dtype == torch.float64


def test_a_far_scene_keeps_its_thickness() -> None:
    # Sheets a ten-thousandth of their distance apart: sums of plain depths would drown them.
    n = 6
    position = torch.zeros(n, 3)
    position[:, 2] = 1000 + 0.1 * torch.arange(n)
    turn = torch.tensor([1.0, 0, 0, 0]).expand(n, 4)
    disks = DiskParameters(position, turn, torch.full((n, 2), 6.0), torch.full((n,), -1.0))
    eye = torch.eye(4, dtype=torch.float64)
    expected = render(DiskParameters(*(p.double() for p in disks)), CAMERA, eye)
    out = render(disks, CAMERA, eye)
    assert relative(out.distortion, expected.distortion) < 2e-3
    assert expected.distortion.max() > 0.01


def test_a_disk_is_the_same_after_half_a_turn_about_its_normal() -> None:
    disks = ordinary()
    half_turn = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(160, 4)
    turned = disks._replace(quaternion=quaternion_multiply(disks.quaternion, half_turn))
    a, b = render(disks, CAMERA, pose()), render(turned, CAMERA, pose())
    assert relative(a.depth, b.depth.double()) < 1e-5
    assert relative(a.normal, b.normal.double()) < 1e-5


def test_exponential() -> None:
    x = np.linspace(0, 8, 10001, dtype=np.float32)
    out = np.empty_like(x)

    @numba.njit
    def fill(x: np.ndarray, out: np.ndarray) -> None:
        for i in range(x.shape[0]):
            out[i] = exp_minus(x[i])

    fill(x, out)
    assert np.abs(out / np.exp(-x.astype(np.float64)) - 1).max() < 3e-6


def test_pixel_loops_are_vectorised() -> None:
    """The speed rests on it, and a small change of a kernel can lose it."""
    f, u = numba.float32, numba.uint64
    row = f[::1]
    for kernel, extra in ((blend_disk, ()), (unblend_disk, (row,))):
        signature = (row, u, u, row, f, f, f, *extra)
        kernel.compile(signature)
        code = kernel.inspect_llvm(signature)
        assert re.search(r"fdiv fast <(8|16) x float>", code), kernel
