"""The CUDA renderer against its specification: emulated everywhere, on a GPU where there is one."""

from collections.abc import Callable

import pytest
import torch

from cuda_emulator import use_emulator
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.splat.cuda import rasterize
from geogs.splat.render import NEAR, Rasterized, RenderOutput, render
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


@pytest.fixture(params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """Where the kernels run."""
    if request.param == "emulated":
        use_emulator(monkeypatch, rasterize)
        return torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("needs an NVIDIA GPU")
    return torch.device("cuda")


@pytest.mark.parametrize("scene", SCENES)
def test_maps_and_gradients_match_the_reference(
    scene: Callable[[], DiskParameters], device: torch.device
) -> None:
    # Across a disk seen edge-on, float32 pixel offsets are coarse.
    tolerance = 1e-3 if scene is edge_on else 1e-4
    expected, gradients = differentiate(scene(), CAMERA, "reference", torch.float64)
    out, found = differentiate(scene(), CAMERA, "cuda", torch.float32, device)
    assert torch.equal(out.visible.cpu(), expected.visible)
    for name in (*MAPS, "median_depth"):
        assert relative(getattr(out, name).cpu(), getattr(expected, name)) < tolerance, name
    names = (*DiskParameters._fields, "T_cw")
    for name, a, b in zip(names, found, gradients, strict=True):
        assert (b.norm() == 0) == (scene is tiny and name == "log_scale"), name
        assert relative(a, b) < 10 * tolerance, name


@pytest.mark.parametrize(("width", "height"), [(1, 1), (16, 16), (17, 33), (40, 9)])
def test_any_image_size(width: int, height: int, device: torch.device) -> None:
    camera = Camera(fx=40.0, fy=40.0, cx=width / 2, cy=height / 2, width=width, height=height)
    disks = disks_at(100, 11, -1.5)
    expected, gradients = differentiate(disks, camera, "reference", torch.float64)
    out, found = differentiate(disks, camera, "cuda", torch.float32, device)
    assert out.depth.shape == (height, width)
    for name in MAPS:
        assert relative(getattr(out, name).cpu(), getattr(expected, name)) < 1e-4, name
    for a, b in zip(found, gradients, strict=True):
        assert relative(a, b) < 1e-3


def test_long_lists_are_sorted(device: torch.device) -> None:
    # More disks in one tile than its keys fit into shared memory.
    camera = Camera(fx=20.0, fy=20.0, cx=5.0, cy=5.0, width=11, height=10)
    disks = disks_at(5200, 3, -1.0)._replace(opacity_logit=torch.full((5200,), -4.0))
    expected = render(disks, camera, pose(), backend="cpu")
    out = render(DiskParameters(*(p.to(device) for p in disks)), camera, pose(), backend="cuda")
    assert int(expected.visible.sum()) > 2048
    for name in MAPS:
        assert relative(getattr(out, name).cpu(), getattr(expected, name).double()) < 1e-4, name


def test_empty_map_and_nothing_in_view(device: torch.device) -> None:
    empty = GaussianMap.empty(device)
    out = render(empty, CAMERA, pose(), backend="cuda")
    assert all(getattr(out, name).abs().max() == 0 for name in MAPS)
    (out.depth.sum() + out.alpha.sum()).backward()
    assert empty.position.grad is not None
    assert empty.position.grad.shape == (0, 3)
    behind = ordinary()._replace(position=-ordinary().position)
    out, gradients = differentiate(behind, CAMERA, "cuda", torch.float32, device)
    assert out.alpha.abs().max() == 0
    assert not out.visible.any()
    assert all(g.abs().max() == 0 for g in gradients)


def test_bad_numbers_do_no_harm(device: torch.device) -> None:
    disks = DiskParameters(*(p.clone() for p in ordinary()))
    for row, value in enumerate((torch.nan, torch.inf, -torch.inf, 1e30)):
        for group in disks[:3]:
            group[row] = value
    disks.opacity_logit[:3] = torch.nan
    disks.quaternion[5] = 0
    out, gradients = differentiate(disks, CAMERA, "cuda", torch.float32, device)
    assert all(torch.isfinite(getattr(out, name)).all() for name in MAPS)
    assert all(torch.isfinite(g).all() for g in gradients)
    kept = DiskParameters(*(p[[4, *range(6, 160)]] for p in disks))
    alone = render(kept, CAMERA, pose(), backend="cpu")
    assert relative(out.depth.cpu(), alone.depth.double()) < 1e-5


def test_views_together_are_views_alone(device: torch.device) -> None:
    leaves = [p.to(device).requires_grad_() for p in ordinary()]
    disks = DiskParameters(*leaves)
    shifts = torch.tensor([[0.0] * 6, [0.1] * 6, [0.0, 0, 9, 0, 0, 0]], dtype=torch.float64)
    poses = (se3_exp(shifts) @ pose()).requires_grad_()
    g = torch.Generator().manual_seed(1)
    weights = torch.randn(3, 75, 45, generator=g).to(device)

    def loss(out: RenderOutput, w: torch.Tensor) -> torch.Tensor:
        rest = out.normal[..., 0] + out.alpha + out.distortion
        return ((out.depth + rest) * w).sum()

    both = RenderOutput(*Rasterized.apply("cuda", CAMERA, NEAR, poses, *disks))
    together = torch.autograd.grad(loss(both, weights), [*leaves, poses])
    views = [render(disks, CAMERA, T, backend="cuda") for T in poses]
    total = sum(loss(v, w) for v, w in zip(views, weights, strict=True))
    alone = torch.autograd.grad(total, [*leaves, poses])
    for name in (*MAPS, "median_depth"):
        stacked = torch.stack([getattr(v, name) for v in views])
        assert torch.equal(getattr(both, name), stacked), name
    assert torch.equal(both.visible, torch.stack([v.visible for v in views]).any(0))
    for a, b in zip(together, alone, strict=True):
        assert relative(a, b.double()) < 1e-5


def test_some_gradients_may_be_missing(device: torch.device) -> None:
    leaves = [p.to(device).requires_grad_() for p in ordinary()]
    doubles = [p.double().requires_grad_() for p in ordinary()]
    for name in MAPS:
        out = render(DiskParameters(*leaves), CAMERA, pose(), backend="cuda")
        exact = render(DiskParameters(*doubles), CAMERA, pose(), backend="reference")
        found = torch.autograd.grad(getattr(out, name).square().sum(), leaves)
        expected = torch.autograd.grad(
            getattr(exact, name).square().sum(), doubles, allow_unused=True
        )
        for a, b in zip(found, expected, strict=True):
            b = torch.zeros_like(a, dtype=torch.float64) if b is None else b
            assert relative(a.cpu(), b.cpu()) < 1e-3, name


def test_renderings_wait_for_their_backward_pass_and_notice_changes(device: torch.device) -> None:
    disks = DiskParameters(*(p.to(device).requires_grad_() for p in ordinary()))
    other = se3_exp(torch.full((6,), 0.1, dtype=torch.float64))
    first = render(disks, CAMERA, pose(), backend="cuda")
    alone = torch.autograd.grad(
        render(disks, CAMERA, pose(), backend="cuda").depth.square().sum(), disks
    )
    render(disks, CAMERA, other, backend="cuda")
    late = torch.autograd.grad(first.depth.square().sum(), disks)
    assert all(relative(a, b.double()) < 1e-6 for a, b in zip(late, alone, strict=True))
    out = render(disks, CAMERA, pose(), backend="cuda")
    with torch.no_grad():
        disks.position.add_(0.1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.depth.sum().backward()


@pytest.mark.gpu
def test_streams_and_devices() -> None:
    if not torch.cuda.is_available():
        pytest.skip("needs an NVIDIA GPU")
    disks = DiskParameters(*(p.cuda() for p in ordinary()))
    expected = render(disks, CAMERA, pose())
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        out = render(disks, CAMERA, pose())
    stream.synchronize()
    assert torch.equal(out.depth, expected.depth)
    for index in range(1, torch.cuda.device_count()):
        there = DiskParameters(*(p.to(f"cuda:{index}") for p in disks))
        assert torch.equal(render(there, CAMERA, pose()).depth.cpu(), expected.depth.cpu())


def test_more_entries_than_room_are_rendered_again(device: torch.device) -> None:
    # Every disk covers the whole image: many more entries than were expected.
    camera = Camera(fx=60.0, fy=60.0, cx=48.0, cy=40.0, width=96, height=80)
    wide = disks_at(40, 2, 1.5)._replace(opacity_logit=torch.full((40,), -1.0))
    disks = DiskParameters(*(p.to(device) for p in wide))
    expected = render(wide, camera, pose(), backend="cpu")
    for _ in range(2):
        out = render(disks, camera, pose(), backend="cuda")
        for name in MAPS:
            assert relative(getattr(out, name).cpu(), getattr(expected, name).double()) < 1e-4, name


def test_hits_held_at_the_near_plane_move_with_the_centre(device: torch.device) -> None:
    expected = held_at_the_near_plane("reference", torch.float64, "cpu")
    found = held_at_the_near_plane("cuda", torch.float32, str(device))
    for a, b in zip(found, expected, strict=True):
        assert relative(a, b) < 1e-3
