"""The renderer's specification against closed forms and finite differences."""

import math

import pytest
import torch

from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.splat import reference
from geogs.splat.reference import distortion
from geogs.splat.render import RenderOutput, render
from geogs.world.disks import DiskParameters

CAMERA = Camera(fx=11.0, fy=12.0, cx=4.3, cy=3.1, width=9, height=7)
IDENTITY = torch.eye(4, dtype=torch.float64)


def random_disks(n: int, seed: int = 0) -> DiskParameters:
    g = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> torch.Tensor:
        return torch.randn(size, generator=g, dtype=torch.float64)

    position = normal(n, 3) * torch.tensor([0.8, 0.6, 0.8]) + torch.tensor([0.0, 0.0, 3.0])
    return DiskParameters(position, normal(n, 4), 0.4 * normal(n, 2) - 1, normal(n))


def one_disk(
    position: list[float], quaternion: list[float], scale: list[float], opacity: float
) -> DiskParameters:
    row = (torch.tensor([x], dtype=torch.float64) for x in (position, quaternion, scale))
    p, q, s = row
    return DiskParameters(p, q, s.log(), torch.tensor([opacity], dtype=torch.float64).logit())


def facing_disks(n: int, seed: int) -> DiskParameters:
    """Disks seen well enough that no hit is held to its disk's extent, a constant by definition."""
    disks = random_disks(n, seed)
    quaternion = 0.35 * disks.quaternion / disks.quaternion.norm(dim=1, keepdim=True)
    front = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    return disks._replace(quaternion=1.3 * (quaternion + front), log_scale=disks.log_scale + 0.6)


def weighted_sum(out: RenderOutput, seed: int = 1) -> torch.Tensor:
    """A loss in which every differentiable map takes part."""
    g = torch.Generator().manual_seed(seed)
    maps = (out.depth, out.normal, out.alpha, out.distortion)
    return sum(
        (m * torch.randn(m.shape, generator=g, dtype=torch.float64).to(m)).sum() for m in maps
    )


def test_frontal_disk_has_the_closed_form() -> None:
    camera = Camera(fx=40.0, fy=40.0, cx=8.0, cy=6.0, width=17, height=13)
    out = render(one_disk([0, 0, 2.0], [1.0, 0, 0, 0], [0.2, 0.1], 0.8), camera, IDENTITY)
    # Deviations are 4 and 2 pixels: three quarters of the way to pixel (11, 6) along x.
    assert out.alpha[6, 8].item() == pytest.approx(0.8, rel=1e-12)
    assert out.alpha[6, 11].item() == pytest.approx(0.8 * math.exp(-0.5 * 0.75**2), rel=1e-12)
    assert out.alpha[8, 8].item() == pytest.approx(0.8 * math.exp(-0.5), rel=1e-12)
    hit = out.alpha > 0
    assert torch.allclose(out.depth[hit], torch.tensor(2.0, dtype=torch.float64))
    assert torch.equal(out.median_depth[hit], out.depth[hit])
    assert torch.allclose(out.normal[hit][:, 2], -out.alpha[hit])
    assert out.distortion.abs().max() == 0
    assert out.depth[~hit].abs().max() == 0
    assert out.visible.tolist() == [True]


def test_tilted_disk_has_the_depth_of_its_plane() -> None:
    angle = 0.7
    quaternion = [math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0]
    out = render(one_disk([0.1, 0, 2.0], quaternion, [1.0, 1.0], 0.9), CAMERA, IDENTITY)
    normal = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
    plane = normal @ torch.tensor([0.1, 0, 2.0], dtype=torch.float64)
    expected = plane / (CAMERA.rays(torch.float64) @ normal)
    on_plane = out.alpha > 0.3
    assert on_plane.sum() > 10
    assert torch.allclose(out.depth[on_plane], expected[on_plane], rtol=1e-12)


def test_small_disk_is_blurred_to_a_pixel() -> None:
    camera = Camera(fx=40.0, fy=40.0, cx=8.0, cy=6.0, width=17, height=13)
    out = render(one_disk([0, 0, 2.0], [1.0, 0, 0, 0], [1e-4, 1e-4], 0.8), camera, IDENTITY)
    assert out.alpha[6, 9].item() == pytest.approx(0.8 * math.exp(-1.0), rel=1e-9)
    assert out.alpha[7, 9].item() == pytest.approx(0.8 * math.exp(-2.0), rel=1e-9)


def test_blurred_depth_stays_within_the_disk() -> None:
    # Seen almost edge-on, the plane is met far from the disk one pixel beside its line.
    angle = math.pi / 2 - 0.01
    quaternion = [math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0]
    out = render(one_disk([0, 0, 2.0], quaternion, [0.05, 0.05], 0.9), CAMERA, IDENTITY)
    hit = out.alpha > 0
    assert hit.sum() > 3
    reach = 3 * 0.05 * math.sin(angle)
    assert (out.depth[hit] - 2).abs().max().item() <= reach + 1e-12
    assert (out.depth[hit] - 2).abs().max().item() > 0.9 * reach


def test_light_never_falls_below_its_bound() -> None:
    n = 40
    disks = random_disks(n)._replace(
        opacity_logit=torch.full((n,), 9.0, dtype=torch.float64),
        log_scale=torch.full((n, 2), 1.0, dtype=torch.float64),
    )
    out = render(disks, CAMERA, IDENTITY)
    assert out.alpha.max() <= 1 - 1e-4
    assert out.alpha.min() > 0.98


def test_unusable_disks_are_ignored() -> None:
    disks = random_disks(8)
    bad = DiskParameters(*(p.clone() for p in disks))
    bad.position[0, 2] = -1.0
    bad.position[1, 0] = torch.nan
    bad.quaternion[2] = 0
    bad.log_scale[3, 1] = torch.inf
    bad.opacity_logit[4] = -20
    good = DiskParameters(*(p[5:] for p in disks))
    a, b = render(bad, CAMERA, IDENTITY), render(good, CAMERA, IDENTITY)
    assert torch.equal(a.depth, b.depth)
    assert a.visible.tolist() == [False] * 5 + b.visible.tolist()
    assert b.visible.any()


def test_distortion_is_the_double_sum_on_sorted_hits() -> None:
    g = torch.Generator().manual_seed(0)
    w = torch.rand(20, 15, generator=g, dtype=torch.float64)
    z = torch.rand(20, 15, generator=g, dtype=torch.float64).cumsum(1)
    pairs = w[:, :, None] * w[:, None, :] * (z[:, :, None] - z[:, None, :]).abs()
    assert torch.allclose(distortion(w, z), pairs.sum((1, 2)), rtol=1e-12)
    shuffled = z[:, torch.randperm(15, generator=g)]
    pairs = w[:, :, None] * w[:, None, :] * (shuffled[:, :, None] - shuffled[:, None, :]).abs()
    value = distortion(w, shuffled)
    assert (value >= 0).all()
    assert (value <= pairs.sum((1, 2)) + 1e-12).all()


def test_rendered_distortion_of_a_stack_is_the_double_sum() -> None:
    depths, opacities = [1.0, 1.5, 1.6, 2.5], [0.3, 0.5, 0.2, 0.6]
    stack = [
        one_disk([0, 0, d], [1.0, 0, 0, 0], [5.0, 5.0], o)
        for d, o in zip(depths, opacities, strict=True)
    ]
    disks = DiskParameters(*(torch.cat(p) for p in zip(*stack, strict=True)))
    camera = Camera(fx=10.0, fy=10.0, cx=0.0, cy=0.0, width=1, height=1)
    out = render(disks, camera, IDENTITY)
    weights, light = [], 1.0
    for o in opacities:
        weights.append(light * o)
        light *= 1 - o
    expected = sum(
        a * b * abs(p - q)
        for a, p in zip(weights, depths, strict=True)
        for b, q in zip(weights, depths, strict=True)
    )
    assert out.distortion.item() == pytest.approx(expected, rel=1e-12)
    # Light in front of the disks: 1, 0.7, 0.35: the second is the last above a half.
    assert out.median_depth.item() == 1.5


@pytest.mark.parametrize("group", range(4))
def test_parameter_gradients_match_finite_differences(group: int) -> None:
    disks = facing_disks(12, seed=0)
    T_cw = se3_exp(torch.tensor([0.1, -0.05, 0.2, 0.1, 0.2, -0.1], dtype=torch.float64))
    leaf = disks[group].clone().requires_grad_()

    def loss(p: torch.Tensor) -> torch.Tensor:
        names = DiskParameters._fields
        return weighted_sum(render(disks._replace(**{names[group]: p}), CAMERA, T_cw))

    (gradient,) = torch.autograd.grad(loss(leaf), leaf)
    assert gradient.norm() > 1
    step = 1e-6
    for k in range(leaf.numel()):
        d = torch.zeros(leaf.numel(), dtype=torch.float64)
        d[k] = step
        d = d.view_as(leaf)
        numeric = (loss(disks[group] + d) - loss(disks[group] - d)) / (2 * step)
        assert gradient.flatten()[k].item() == pytest.approx(numeric.item(), rel=1e-5, abs=1e-6)


def test_pose_gradient_matches_finite_differences() -> None:
    disks = facing_disks(12, seed=3)
    T0 = se3_exp(torch.tensor([0.1, -0.05, 0.2, 0.1, 0.2, -0.1], dtype=torch.float64))

    def loss(xi: torch.Tensor) -> torch.Tensor:
        return weighted_sum(render(disks, CAMERA, se3_exp(xi) @ T0))

    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(xi), xi)
    for k in range(6):
        d = torch.zeros(6, dtype=torch.float64)
        d[k] = 1e-6
        numeric = (loss(d) - loss(-d)) / 2e-6
        assert gradient[k].item() == pytest.approx(numeric.item(), rel=1e-5, abs=1e-6)


def test_depth_held_to_the_disk_moves_with_its_centre() -> None:
    angle = math.pi / 2 - 0.01
    quaternion = [math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0]
    disk = one_disk([0, 0, 2.0], quaternion, [0.05, 0.05], 0.9)
    disks = DiskParameters(*(p.requires_grad_() for p in disk))
    depth = render(disks, CAMERA, IDENTITY).depth[3, 5]
    assert (depth - 2).abs().item() == pytest.approx(0.15 * math.sin(angle), rel=1e-9)
    gradients = torch.autograd.grad(depth, disks, allow_unused=True)
    assert torch.allclose(gradients[0], torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))
    assert all(g.abs().max() < 1e-9 for g in gradients[1:])


def test_pieces_give_the_whole_image(monkeypatch: pytest.MonkeyPatch) -> None:
    disks = DiskParameters(*(p.requires_grad_() for p in random_disks(12)))
    whole = render(disks, CAMERA, IDENTITY)
    expected = torch.autograd.grad(weighted_sum(whole), disks)
    monkeypatch.setattr(reference, "_CHUNK_ELEMENTS", 12 * 10)
    pieces = render(disks, CAMERA, IDENTITY)
    assert torch.allclose(pieces.depth, whole.depth, rtol=1e-14)
    assert torch.equal(pieces.visible, whole.visible)
    for a, b in zip(torch.autograd.grad(weighted_sum(pieces), disks), expected, strict=True):
        assert torch.allclose(a, b, rtol=1e-10)
