"""Scenes of disks that a renderer has to get right."""

import math

import torch

from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.splat.render import RenderOutput, render
from geogs.world.disks import DiskParameters

CAMERA = Camera(fx=50.0, fy=53.0, cx=22.4, cy=37.7, width=45, height=75)


MAPS = ("depth", "normal", "alpha", "distortion")


def differentiate(
    disks: DiskParameters,
    camera: Camera,
    backend: str,
    dtype: torch.dtype,
    device: torch.device | str = "cpu",
) -> tuple[RenderOutput, list[torch.Tensor]]:
    """The rendering, and gradients of a loss of all maps for the parameters and the pose."""
    leaves = [p.to(device, dtype).requires_grad_() for p in disks]
    T_cw = pose().requires_grad_()
    out = render(DiskParameters(*leaves), camera, T_cw, backend=backend)
    g = torch.Generator().manual_seed(0)
    maps = [getattr(out, name) for name in MAPS]
    loss = sum(
        (m * torch.randn(m.shape, generator=g, dtype=torch.float64).to(m)).sum() for m in maps
    )
    return out, [x.cpu() for x in torch.autograd.grad(loss, [*leaves, T_cw])]


def disks_at(n: int, seed: int, scale: float, spread: float = 0.4) -> DiskParameters:
    """Disks of random attitude in the view; ``scale`` is the mean log-scale."""
    g = torch.Generator().manual_seed(seed)
    z = 1.5 + 3 * torch.rand(n, generator=g)
    xy = (torch.rand(n, 2, generator=g) - 0.5) * torch.tensor([1.1, 1.6]) * z[:, None]
    return DiskParameters(
        torch.cat([xy, z[:, None]], 1),
        torch.randn(n, 4, generator=g),
        spread * torch.randn(n, 2, generator=g) + scale,
        1.5 * torch.randn(n, generator=g),
    )


def ordinary() -> DiskParameters:
    return disks_at(160, 0, -1.7)


def around_the_camera() -> DiskParameters:
    disks = disks_at(150, 1, -1.5)
    g = torch.Generator().manual_seed(2)
    return disks._replace(position=2 * torch.randn(150, 3, generator=g))


def edge_on() -> DiskParameters:
    """Normals at right angles to the line of sight, up to a thousandth."""
    disks = disks_at(60, 3, -1.5)
    g = torch.Generator().manual_seed(4)
    sight = torch.nn.functional.normalize(disks.position, dim=1)
    other = torch.nn.functional.normalize(torch.randn(60, 3, generator=g), dim=1)
    normal = torch.linalg.cross(sight, other) + 1e-3 * torch.randn(60, 3, generator=g)
    z = torch.tensor([0.0, 0.0, 1.0]).expand(60, 3)
    normal = torch.nn.functional.normalize(normal, dim=1)
    w = 1 + (normal * z).sum(1, keepdim=True)
    return disks._replace(quaternion=torch.cat([w, torch.linalg.cross(z, normal)], 1))


def huge() -> DiskParameters:
    return disks_at(30, 5, 2.0)


def tiny() -> DiskParameters:
    return disks_at(150, 6, -9.0)


def nearly_transparent() -> DiskParameters:
    disks = disks_at(150, 7, -1.0)
    return disks._replace(opacity_logit=torch.linspace(-9, -4, 150))


def nearly_opaque() -> DiskParameters:
    disks = disks_at(150, 8, -1.0)
    return disks._replace(opacity_logit=torch.linspace(3, 20, 150))


def single() -> DiskParameters:
    return disks_at(1, 9, -1.0)


def crossing() -> DiskParameters:
    """A fan of large disks through one line."""
    angle = torch.linspace(-1.2, 1.2, 9)
    zero = torch.zeros(9)
    turn = torch.stack([(angle / 2).cos(), zero, (angle / 2).sin(), zero], 1)
    position = torch.tensor([0.0, 0.0, 3.0]) + 0.02 * torch.arange(9)[:, None]
    scale, opacity = torch.full((9, 2), -0.3), torch.full((9,), -0.5)
    return DiskParameters(position, turn, scale, opacity)


def covering() -> DiskParameters:
    """A floor that begins behind the camera, a wall across the view, and small disks between."""
    half = 0.5**0.5
    disks = disks_at(50, 10, -2.0)
    position = torch.tensor([[0.0, 0.4, 1.0], [0.0, 0.0, 6.0]])
    turn = torch.tensor([[half, half, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]])
    extra = DiskParameters(
        position, turn, torch.tensor([[2.0, 2.0], [3.0, 3.0]]), torch.tensor([1.0, 1.0])
    )
    return DiskParameters(*(torch.cat(p) for p in zip(disks, extra, strict=True)))


SCENES = [
    ordinary, around_the_camera, edge_on, huge, tiny, nearly_transparent, nearly_opaque, single,
    crossing, covering,
]  # fmt: skip


def pose() -> torch.Tensor:
    return se3_exp(torch.tensor([0.05, -0.02, 0.1, 0.02, 0.05, -0.03], dtype=torch.float64))


def relative(a: torch.Tensor, b: torch.Tensor) -> float:
    return ((a.double() - b).norm() / b.norm().clamp(min=1e-12)).item()


def held_at_the_near_plane(backend: str, dtype: torch.dtype, device: str) -> list[torch.Tensor]:
    """Gradients of a tilted disk that reaches the near plane, so that hits are held there."""
    half = 1.55 / 2
    parameters = (
        [[0.02, 0.01, 0.6]], [[math.cos(half), math.sin(half), 0.05, 0.0]], [[-0.5, -0.7]], [1.0],
    )  # fmt: skip
    leaves = [torch.tensor(p).to(device, dtype).requires_grad_() for p in parameters]
    camera = Camera(fx=40.0, fy=40.0, cx=20.0, cy=15.0, width=41, height=31)
    eye = torch.eye(4, dtype=torch.float64)
    out = render(DiskParameters(*leaves), camera, eye, backend=backend, near=0.5)
    g = torch.Generator().manual_seed(0)
    weight = torch.randn(31, 41, generator=g, dtype=torch.float64).to(out.depth)
    found = torch.autograd.grad((out.depth * weight).sum(), leaves[:2])
    return [x.cpu() for x in found]
