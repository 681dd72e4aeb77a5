"""Self-test of the renderer against its specification on this machine, and its speed."""

import time
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.splat.reference import blend, project_disks
from geogs.splat.render import NEAR, Backend, render
from geogs.threads import on_one_torch_thread
from geogs.world.disks import DiskParameters

MAP_TOLERANCE = 1e-3
"""Largest relative error (norms) of depth, normal, alpha and distortion."""
GRADIENT_TOLERANCE = 1e-2
"""Largest relative error of a gradient: single precision, and hits close to a threshold."""
_PIXEL_STEP = 4
_TESTED_DISKS, _TIMED_DISKS = 2000, 30_000


@dataclass(frozen=True)
class Agreement:
    """Largest relative errors of a backend in float32 against the reference in float64."""

    maps: float
    gradients: float

    @property
    def is_good(self) -> bool:
        """Whether both are within the tolerances; false for NaN."""
        return self.maps < MAP_TOLERANCE and self.gradients < GRADIENT_TOLERANCE


@on_one_torch_thread
def check_renderer(device: torch.device) -> Agreement:
    """Compare the backend of ``device`` with the specification, forward and backward.

    The image has 160 x 120 pixels, of which every fourth in either direction is compared, as the
    specification is slow.
    """
    camera = _camera(160, 120)
    scene = wavy_wall(_TESTED_DISKS, camera)
    T_cw = torch.eye(4, dtype=torch.float64)
    rows = torch.arange(1, camera.height, _PIXEL_STEP)
    columns = torch.arange(1, camera.width, _PIXEL_STEP)
    random = torch.Generator().manual_seed(0)
    weights = torch.randn(len(rows), len(columns), 6, generator=random, dtype=torch.float64)
    tested = _render(scene, camera, T_cw, device)
    chosen = tested.maps[rows.to(device)[:, None], columns.to(device)]
    own = torch.autograd.grad(chosen, tested.leaves, weights.to(chosen))
    v, u = torch.meshgrid(rows.double(), columns.double(), indexing="ij")
    specified = _specification(scene, camera, T_cw, torch.stack([u, v], -1).flatten(0, 1))
    true = torch.autograd.grad(specified.maps, specified.leaves, weights.flatten(0, 1))
    pairs = zip(
        chosen.detach().flatten(0, 1).unbind(-1), specified.maps.detach().unbind(-1), strict=True
    )
    return Agreement(
        max(_relative(a, b) for a, b in pairs),
        max(_relative(a, b) for a, b in zip(own, true, strict=True)),
    )


@on_one_torch_thread
def time_renderer(device: torch.device, repeats: int = 20) -> float:
    """Median milliseconds of one forward and backward pass at 616 x 344 pixels."""
    camera = _camera(616, 344)
    scene = DiskParameters(*(p.to(device, torch.float32) for p in wavy_wall(_TIMED_DISKS, camera)))
    T_cw = torch.eye(4, device=device)
    weights: Tensor | None = None
    times = []
    for number in range(repeats + 2):
        start = _now(device)
        rendered = _render(scene, camera, T_cw, device)
        weights = torch.ones_like(rendered.maps) if weights is None else weights
        torch.autograd.grad(rendered.maps, rendered.leaves, weights)
        if number >= 2:
            times.append(_now(device) - start)
    return 1e3 * sorted(times)[len(times) // 2]


def wavy_wall(count: int, camera: Camera) -> DiskParameters:
    """Disks (float64) on a wavy wall that fills the view, overlapping like those of a map."""
    random = torch.Generator().manual_seed(0)

    def uniform(*size: int) -> Tensor:
        return torch.rand(size, generator=random, dtype=torch.float64)

    def normal(*size: int) -> Tensor:
        return torch.randn(size, generator=random, dtype=torch.float64)

    u, v = uniform(count) * camera.width, uniform(count) * camera.height
    z = 3 + 0.5 * torch.sin(u / 40) + 0.5 * torch.sin(v / 55) + 0.01 * normal(count)
    ray = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], 1)
    spacing = (camera.width * camera.height / max(count, 1)) ** 0.5 / camera.fx
    return DiskParameters(
        position=torch.cat([ray, torch.ones_like(z)[:, None]], 1) * z[:, None],
        quaternion=torch.tensor([1.0, 0, 0, 0]) + 0.25 * normal(count, 4),
        log_scale=(0.75 * spacing * z).log()[:, None] + 0.25 * normal(count, 2),
        opacity_logit=3 * uniform(count) - 0.4,
    )


@dataclass(frozen=True)
class _Rendered:
    maps: Tensor
    """(..., 6): depth, normal, alpha, distortion."""
    leaves: list[Tensor]
    """Inputs of the maps: the disks' parameters and the pose."""


def _render(scene: DiskParameters, camera: Camera, T_cw: Tensor, device: torch.device) -> _Rendered:
    disks = DiskParameters(*(p.to(device, torch.float32).detach().requires_grad_() for p in scene))
    pose = T_cw.to(device).clone().requires_grad_()
    out = render(disks, camera, pose, backend=cast(Backend, device.type))
    parts = [out.depth[..., None], out.normal, out.alpha[..., None], out.distortion[..., None]]
    return _Rendered(torch.cat(parts, -1), [*disks, pose])


def _specification(
    scene: DiskParameters, camera: Camera, T_cw: Tensor, pixels: Tensor
) -> _Rendered:
    disks = DiskParameters(*(p.clone().requires_grad_() for p in scene))
    pose = T_cw.clone().requires_grad_()
    out = blend(project_disks(disks, pose, NEAR), pixels, camera, NEAR)
    parts = [out.depth[:, None], out.normal, out.alpha[:, None], out.distortion[:, None]]
    return _Rendered(torch.cat(parts, -1), [*disks, pose])


def _camera(width: int, height: int) -> Camera:
    return Camera(0.65 * width, 0.65 * width, (width - 1) / 2, (height - 1) / 2, width, height)


def _relative(value: Tensor, truth: Tensor) -> float:
    truth = truth.double()
    return float((value.cpu().double() - truth).norm() / truth.norm().clamp(min=1e-30))


def _now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
