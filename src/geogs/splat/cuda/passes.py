"""The two passes of the renderer on a GPU, on tensors, without autograd."""

import functools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.gpu.transfer import to_device
from geogs.splat.cuda.rasterize import MapGradients, Maps, Rasterizer, Views
from geogs.splat.protocols import Backward
from geogs.world.disks import DiskParameters

_KEPT = 4
"""Idle rasterizers that are kept; the least recently used are dropped."""


@dataclass(frozen=True)
class _Key:
    """Properties of a rendering that decide whether its buffers can be used again."""

    disks: int
    views: int
    camera: Camera
    near: float
    device: torch.device
    stream: int


@dataclass
class RasterizerPool:
    """Lends rasterizers; each returns when its loan is deleted."""

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
    """The process's pool of rasterizers."""
    return RasterizerPool()


def rendered(
    disks: DiskParameters,
    camera: Camera,
    T_cw: Float[Tensor, "*b 4 4"],
    near: float,
    with_trace: bool,
) -> tuple[tuple[Tensor, ...], Backward]:
    """Maps of one pose or of several, as in ``RenderOutput``, on the GPU that holds the disks, and
    their backward pass.

    The backward pass takes the gradients of depth, normal (components last), alpha and distortion,
    None for zero, but not all None. It returns those of the disks and, float64 on their device, of
    the poses. It may be called again, not without trace; it keeps its rasterizer while it exists.

    The compositing is launched before it is known whether the list entries fit, and once more if
    they do not: that is known as soon as the projection is done, while the GPU continues.
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
    shape = (*T_cw.shape[:-2], camera.height, camera.width)

    def back(
        gradients: Sequence[Tensor | None], with_pose: bool
    ) -> tuple[DiskParameters, Float[Tensor, "b 4 4"] | None]:
        d_disks = DiskParameters(*(torch.empty_like(p) for p in disks))
        d_poses = torch.empty_like(views.poses) if with_pose else None
        given = _map_gradients(gradients, shape)
        loan.rasterizer.backward(disks, views, given, d_disks, d_poses)
        return d_disks, d_poses

    normal = maps.normal.movedim(-3, -1)
    shown = maps.depth, normal, maps.alpha, maps.distortion, maps.median_depth, maps.visible
    return shown, back


def _map_gradients(gradients: Sequence[Tensor | None], shape: tuple[int, ...]) -> MapGradients:
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
