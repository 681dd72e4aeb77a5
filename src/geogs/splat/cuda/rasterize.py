"""The passes of the renderer on a GPU."""

import contextlib
import functools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import to_device
from geogs.splat.protocols import Backward
from geogs.world.disks import DiskParameters

SOURCE = Path(__file__).with_name("renderer.cu")
TILE = 16
THREADS = 256
RECORD, OUTLINE, SUMS, POSE_COPIES = 16, 8, 16, 32
"""Floats per disk of the record, of the outline and of the pixels' sums; see the sources."""
_ENTRIES_PER_DISK = 4
"""Initial room in the lists: tiles that a disk reaches in a view, usually fewer."""
_SLACK = 1.25


@dataclass(frozen=True, slots=True)
class Views:
    """Poses from which the disks are seen, and the number of disks."""

    poses: Float[Tensor, "s *k"]
    """World to camera, float64, (s, 3, 4) or (s, 4, 4)."""
    batch: Int[Tensor, "b"] | None = None
    """Indices of the poses, int32 on the device; negative for none. By default all in order."""
    count: Int[Tensor, "1"] | None = None
    """Number of disks, int32 on the device; by default all that the parameters have room for."""


@dataclass(slots=True)
class Maps:
    """Maps of :class:`geogs.splat.render.RenderOutput`, normals with components in front."""

    depth: Float[Tensor, "*b h w"]
    normal: Float[Tensor, "*b 3 h w"]
    alpha: Float[Tensor, "*b h w"]
    distortion: Float[Tensor, "*b h w"]
    median_depth: Float[Tensor, "*b h w"]
    visible: Bool[Tensor, "n"]
    """Whether any view blends a disk."""

    @staticmethod
    def empty(camera: Camera, views: tuple[int, ...], disks: int, device: torch.device) -> "Maps":
        """Uninitialised maps."""
        size = (camera.height, camera.width)
        depth, alpha, spread, median = (torch.empty(*views, *size, device=device) for _ in range(4))
        normal = torch.empty(*views, 3, *size, device=device)
        visible = torch.empty(disks, dtype=torch.bool, device=device)
        return Maps(depth, normal, alpha, spread, median, visible)


@dataclass(slots=True)
class MapGradients:
    """Gradients of a loss with respect to the maps; contiguous float32."""

    depth: Float[Tensor, "*b h w"]
    normal: Float[Tensor, "..."]
    """Components in front, as in the maps, or last."""
    alpha: Float[Tensor, "*b h w"]
    distortion: Float[Tensor, "*b h w"]
    normal_is_planar: bool = True


class Rasterizer:
    """Buffers for a number of views and disks, and the launches that fill them.

    Nothing waits for the GPU and nothing is allocated after ``reserve``, so that the passes can be
    captured in a CUDA graph; only :meth:`has_room` waits. Every buffer that must be clear before a
    pass is cleared by the pass that reads it.
    """

    def __init__(
        self, capacity: int, views: int, camera: Camera, near: float, device: torch.device
    ) -> None:
        self.capacity = capacity
        self.views = views
        self.camera = camera
        self.near = near
        self.device = device
        self._kernels = kernels_for(SOURCE, device)
        self._tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
        self._blocks = -(-capacity // THREADS)
        tiles = views * self._tiles
        pixels = views * camera.height * camera.width
        counts = torch.zeros(2 + tiles, dtype=torch.int32, device=device)
        self.status = counts[:2]
        self._counts = counts[2:]
        """Status: most entries of any pass so far; 1 once there was no room for all of them."""
        places = torch.empty(2 * tiles + 1, dtype=torch.int32, device=device)
        self._offsets = places[: tiles + 1]
        self._cursor = places[tiles + 1 :]
        self._records = torch.empty(views, capacity, RECORD, device=device)
        self._outlines = torch.empty(views, capacity, OUTLINE, device=device)
        self._saved = torch.empty(views, 2, camera.height, camera.width, device=device)
        self._ranks = torch.empty(pixels, dtype=torch.int32, device=device)
        self._sums = torch.zeros(views, capacity, SUMS, device=device)
        self._pose_copies = torch.zeros(POSE_COPIES, views, 12, dtype=torch.float64, device=device)
        # Written by the GPU into the host's memory, so that it can be read without a copy.
        on_gpu = device.type == "cuda"
        self._entries = torch.zeros(1, dtype=torch.int32, pin_memory=on_gpu)
        self._counted = torch.cuda.Event() if on_gpu else None
        self._keys = torch.empty(0, dtype=torch.int64, device=device)
        self._disks = torch.empty(0, dtype=torch.int32, device=device)
        self.reserve(_ENTRIES_PER_DISK * views * capacity + 1)

    @property
    def room(self) -> int:
        """Number of entries (a disk in a tile of a view) that there is room for."""
        return len(self._disks)

    def reserve(self, entries: int) -> None:
        """Make room for ``entries`` in all."""
        if entries > self.room:
            room = int(_SLACK * entries)
            self._keys = torch.empty(room, dtype=torch.int64, device=self.device)
            self._disks = torch.empty(room, dtype=torch.int32, device=self.device)

    def project(self, disks: DiskParameters, views: Views, maps: Maps) -> None:
        """Compute records, outlines and the number of entries of each tile; clear ``visible``."""
        c = self.camera
        self._kernels["project_disks"](
            (self._blocks, self.views), THREADS, self.capacity, views.count, *disks, views.poses,
            views.poses.stride(0), views.batch, c.fx, c.fy, c.cx, c.cy, self.near,
            c.width, c.height, self._records, self._outlines, self._counts, maps.visible,
        )  # fmt: skip
        lists = (self._counts, self._offsets, self._cursor, self.status, self._entries)
        self._kernels["scan_tiles"](1, 1024, self.views * self._tiles, self.room, *lists)

    def note_projection(self) -> None:
        """Let :meth:`has_room` wait only for the work launched so far."""
        if self._counted is not None:
            self._counted.record(torch.cuda.current_stream(self.device))

    def has_room(self) -> bool:
        """Whether the last projection's entries fit; waits for it, and makes room if not."""
        if self._counted is not None:
            self._counted.synchronize()
        entries = int(self._entries)
        fits = entries <= self.room
        self.reserve(entries)
        return fits

    def blend(self, views: Views, maps: Maps, with_trace: bool = True) -> None:
        """List and sort the entries, composite the maps; the backward pass needs the trace."""
        c = self.camera
        self._kernels["list_disks"](
            (self._blocks, self.views), THREADS, self.capacity, views.count, self._records,
            self._outlines, c.width, c.height, self.room, self._cursor, self._keys,
        )  # fmt: skip
        self._kernels["sort_tiles"](
            self.views * self._tiles, THREADS, self.room, self._offsets, self._keys, self._disks
        )
        trace = (self._saved, self._ranks) if with_trace else (None, None)
        self._kernels["blend_tiles"](
            (self._tiles, self.views), THREADS, self.capacity, self._records, self._outlines,
            self._offsets, self._disks, self.room, 1 / self.near, c.width, c.height, maps.depth,
            maps.normal, maps.alpha, maps.distortion, maps.median_depth, *trace, maps.visible,
        )  # fmt: skip

    def backward(
        self,
        disks: DiskParameters,
        views: Views,
        gradients: MapGradients,
        d_disks: DiskParameters | None,
        d_poses: Float[Tensor, "b 4 4"] | None,
    ) -> None:
        """Write the gradients of the disks and of the poses (float64), each unless it is None."""
        c, d = self.camera, gradients
        strides = (1, c.width * c.height) if d.normal_is_planar else (3, 1)
        self._kernels["unblend_tiles"](
            (self._tiles, self.views), THREADS, self.capacity, self._records, self._outlines,
            self._offsets, self._disks, self.room, 1 / self.near, c.width, c.height, self._saved,
            self._ranks, d.depth, d.normal, *strides, d.alpha, d.distortion, self._sums,
        )  # fmt: skip
        self._kernels["project_backward"](
            self._blocks, THREADS, self.capacity, views.count, self.views, *disks, views.poses,
            views.poses.stride(0), views.batch, c.fx, c.fy, self._outlines, self._sums,
            *(d_disks or (None,) * 4), None if d_poses is None else self._pose_copies,
        )  # fmt: skip
        if d_poses is not None:
            self._kernels["sum_poses"](self.views, 32, self.views, self._pose_copies, d_poses)


_Key = tuple[int, int, Camera, float, torch.device, int]
"""Numbers of disks and views, camera, least depth, device and stream: a rasterizer can be used
again where all are the same."""


@functools.cache
def _resting() -> deque[tuple[_Key, Rasterizer]]:
    """The idle rasterizers of the process, the last four used."""
    return deque(maxlen=4)


class Loan:
    """Holds a rasterizer as long as its rendering may still be differentiated."""

    def __init__(self, key: _Key, rasterizer: Rasterizer) -> None:
        self.rasterizer = rasterizer
        self._key = key
        self._resting = _resting()

    def __del__(self) -> None:
        self._resting.append((self._key, self.rasterizer))


def lend(disks: int, views: int, camera: Camera, near: float, device: torch.device) -> Loan:
    """A rasterizer for the current stream, whose order keeps its uses apart."""
    stream = torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0
    key = (disks, views, camera, near, device, stream)
    for entry in list(_resting()):
        if entry[0] == key:
            with contextlib.suppress(ValueError):  # another thread was faster
                _resting().remove(entry)
                return Loan(*entry)
    return Loan(key, Rasterizer(disks, views, camera, near, device))


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
    device = disks.position.device
    n = len(disks.position)
    disks = DiskParameters(*(p.detach().contiguous() for p in disks))
    poses = to_device(T_cw.detach(), device, torch.float64).contiguous().view(-1, 4, 4)
    views = Views(poses)
    loan = lend(n, len(poses), camera, near, device)
    rasterizer = loan.rasterizer
    maps = Maps.empty(camera, T_cw.shape[:-2], n, device)
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
        normal = known.new_zeros((3, *shape), dtype=torch.float32)
        planar = True
    else:
        normal = normal.to(torch.float32)
        planar = normal.movedim(-1, -3).is_contiguous()
        normal = normal.movedim(-1, -3) if planar else normal.contiguous()
    d_depth, d_alpha, d_distortion = (
        (known.new_zeros(shape) if g is None else g).to(torch.float32).contiguous()
        for g in (depth, alpha, distortion)
    )
    return MapGradients(d_depth, normal, d_alpha, d_distortion, planar)
