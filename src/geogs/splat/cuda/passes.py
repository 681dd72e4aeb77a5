"""The two passes of the renderer on a GPU, on tensors, without autograd."""

import functools
from collections import deque
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.gpu.transfer import to_device
from geogs.splat.cuda.rasterize import MapGradients, Maps, Rasterizer, Views
from geogs.world.disks import DiskParameters

_KEPT = 4
"""Rasterizers at rest; those used longest ago are dropped."""


@dataclass(frozen=True)
class _Key:
    """What two renderings must share to use the same buffers one after the other."""

    disks: int
    views: int
    camera: Camera
    near: float
    device: torch.device
    stream: int


@dataclass
class RasterizerPool:
    """Lends rasterizers; each comes back when its loan is given up."""

    _resting: deque[tuple[_Key, Rasterizer]] = field(default_factory=lambda: deque(maxlen=_KEPT))

    def lend(
        self, disks: int, views: int, camera: Camera, near: float, device: torch.device
    ) -> "Loan":
        """A rasterizer for the current stream, whose order keeps its uses apart."""
        stream = torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0
        key = _Key(disks, views, camera, near, device, stream)
        for entry in list(self._resting):
            if entry[0] == key:
                try:
                    self._resting.remove(entry)
                except ValueError:  # another thread was faster
                    continue
                return Loan(self, *entry)
        return Loan(self, key, Rasterizer(disks, views, camera, near, device))

    def take_back(self, key: _Key, rasterizer: Rasterizer) -> None:
        """Keep a rasterizer for the next rendering of its kind."""
        self._resting.append((key, rasterizer))


class Loan:
    """Holds a rasterizer as long as its rendering may still be differentiated."""

    def __init__(self, pool: RasterizerPool, key: _Key, rasterizer: Rasterizer) -> None:
        self.rasterizer = rasterizer
        self._pool, self._key = pool, key

    def __del__(self) -> None:
        self._pool.take_back(self._key, self.rasterizer)


@functools.cache
def _pool() -> RasterizerPool:
    """The process's rasterizers."""
    return RasterizerPool()


@dataclass(frozen=True, slots=True)
class Trace:
    """What a forward pass leaves for backward passes; its rasterizer serves no other meanwhile."""

    disks: DiskParameters
    views: Views
    loan: Loan
    shape: tuple[int, ...]
    """That of the maps: of the poses, then height and width."""


def forward_pass(
    disks: DiskParameters,
    camera: Camera,
    T_cw: Float[Tensor, "*b 4 4"],
    near: float,
    with_trace: bool = True,
) -> tuple[Maps, Trace]:
    """Maps of one pose or of several, on the GPU that holds the disks.

    Without trace a backward pass is not possible.

    The compositing is launched on the guess that the list entries fit where the last ones did, and
    once more if they do not: that is known as soon as the projection is done, while the GPU goes
    on.
    """
    device, n = disks.position.device, len(disks.position)
    disks = DiskParameters(*(p.detach().contiguous() for p in disks))
    poses = to_device(T_cw.detach(), device, torch.float64).contiguous().view(-1, 4, 4)
    views, loan = Views(poses), _pool().lend(n, len(poses), camera, near, device)
    rasterizer, maps = loan.rasterizer, Maps.empty(camera, T_cw.shape[:-2], n, device)
    rasterizer.project(disks, views, maps)
    rasterizer.note_projection()
    rasterizer.blend(views, maps, with_trace)
    if not rasterizer.has_room():
        rasterizer.project(disks, views, maps)
        rasterizer.blend(views, maps, with_trace)
    return maps, Trace(disks, views, loan, (*T_cw.shape[:-2], camera.height, camera.width))


def backward_pass(
    trace: Trace, gradients: tuple[Tensor | None, ...], with_poses: bool
) -> tuple[DiskParameters, Float[Tensor, "b 4 4"] | None]:
    """Gradients of the disks and, float64 on their device, of the poses.

    ``gradients`` are those of depth, normal (components last), alpha and distortion; None for zero,
    but not all of them. May be asked for again.
    """
    d_disks = DiskParameters(*(torch.empty_like(p) for p in trace.disks))
    d_poses = torch.empty_like(trace.views.poses) if with_poses else None
    maps = _map_gradients(gradients, trace.shape)
    trace.loan.rasterizer.backward(trace.disks, trace.views, maps, d_disks, d_poses)
    return d_disks, d_poses


def _map_gradients(gradients: tuple[Tensor | None, ...], shape: tuple[int, ...]) -> MapGradients:
    """Contiguous float32 gradients; zeros for those that are missing."""
    known = next(g for g in gradients if g is not None)
    depth, normal, alpha, distortion = gradients
    if normal is None:
        normal, planar = known.new_zeros((3, *shape), dtype=torch.float32), True
    else:
        normal = normal.to(torch.float32)
        planar = normal.movedim(-1, -3).is_contiguous()
        normal = normal.movedim(-1, -3) if planar else normal.contiguous()
    plain = (
        known.new_zeros(shape, dtype=torch.float32)
        if g is None
        else g.to(torch.float32).contiguous()
        for g in (depth, alpha, distortion)
    )
    d_depth, d_alpha, d_distortion = plain
    return MapGradients(d_depth, normal, d_alpha, d_distortion, planar)
