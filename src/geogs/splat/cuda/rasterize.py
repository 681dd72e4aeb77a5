"""The passes of the renderer on a GPU."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.gpu.kernels import kernels_for
from geogs.splat.map import DiskParameters

SOURCE = Path(__file__).with_name("renderer.cu")
TILE = 16
THREADS = 256
RECORD, OUTLINE, SUMS, POSE_COPIES = 16, 8, 16, 32
"""Floats per disk of the record, of the outline and of the pixels' sums; see the sources."""
UNLIMITED = 2**31 - 1


@dataclass(frozen=True, slots=True)
class Views:
    """Where the disks are seen from, and how many disks there are."""

    poses: Float[Tensor, "s 3 4"]
    """World to camera, float64."""
    batch: Int[Tensor, "b"] | None = None
    """Which of the poses, int32 on the device; negative for none. All in order if not given."""
    count: Int[Tensor, "1"] | None = None
    """Number of disks, int32 on the device; all that the parameters have room for if not given."""


@dataclass(slots=True)
class Maps:
    """What :class:`geogs.splat.render.RenderOutput` holds, for several views."""

    depth: Float[Tensor, "b h w"]
    normal: Float[Tensor, "b 3 h w"]
    alpha: Float[Tensor, "b h w"]
    distortion: Float[Tensor, "b h w"]
    median_depth: Float[Tensor, "b h w"]
    visible: Bool[Tensor, "n"]
    """Of any view."""


@dataclass(slots=True)
class MapGradients:
    """Of a loss, with respect to the maps; contiguous float32."""

    depth: Float[Tensor, "b h w"]
    normal: Float[Tensor, "..."]
    """(b, 3, h, w) or (b, h, w, 3)."""
    alpha: Float[Tensor, "b h w"]
    distortion: Float[Tensor, "b h w"]


@dataclass(slots=True)
class Gradients:
    """Of the disks' parameters, and of the upper three rows of every view's pose (float64)."""

    parameters: DiskParameters
    poses: Float[Tensor, "b 3 4"] | None


class Rasterizer:
    """Buffers of a number of views and disks, and the launches that fill them.

    Nothing waits for the GPU and nothing is allocated after the constructor, so that the passes can
    be captured in a CUDA graph; only :meth:`entries` reads something back.
    """

    def __init__(
        self,
        capacity: int,
        views: int,
        camera: Camera,
        near: float,
        device: torch.device,
        with_trace: bool = True,
    ) -> None:
        self.capacity, self.views, self.camera, self.near = capacity, views, camera, near
        self.kernels = kernels_for(SOURCE, device)
        self.tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
        self.blocks = -(-capacity // THREADS)
        tiles, pixels = views * self.tiles, views * camera.height * camera.width
        # Cleared together: most entries so far, overflow, tile counts, visible.
        self._cleared = torch.zeros(2 + tiles + -(-capacity // 4), dtype=torch.int32, device=device)
        self.status, self._counts = self._cleared[:2], self._cleared[2 : 2 + tiles]
        places = torch.empty(2 * tiles + 1, dtype=torch.int32, device=device)
        self._offsets, self._cursor = places[: tiles + 1], places[tiles + 1 :]
        self._records = torch.empty(views, capacity, RECORD, device=device)
        self.outlines = torch.empty(views, capacity, OUTLINE, device=device)
        shape = (views, camera.height, camera.width)
        planes = torch.empty(10 if with_trace else 7, pixels, device=device)
        self.maps = Maps(
            depth=planes[0].view(shape),
            normal=planes[4:7].view(views, 3, *shape[1:]),
            alpha=planes[1].view(shape),
            distortion=planes[2].view(shape),
            median_depth=planes[3].view(shape),
            visible=self._cleared[2 + tiles :].view(torch.bool)[:capacity],
        )
        self._saved = planes[7:9] if with_trace else None
        self._ranks = planes[9].view(torch.int32) if with_trace else None
        self._keys = self._disks = torch.empty(0, dtype=torch.int32, device=device)
        self.room = 0

    def reserve(self, room: int) -> None:
        """Make room for so many entries (a disk in a tile) in all."""
        device = self._records.device
        self.room = room
        self._keys = torch.empty(room, dtype=torch.int64, device=device)
        self._disks = torch.empty(room, dtype=torch.int32, device=device)

    def clear(self) -> None:
        """Forget which disks were visible and whether the entries had room."""
        self._cleared.zero_()

    def project(self, disks: DiskParameters, views: Views) -> None:
        """Records, outlines and the number of entries of each tile."""
        c = self.camera
        self.kernels["project_disks"](
            (self.blocks, self.views), THREADS, self.capacity, views.count, *disks, views.poses,
            views.batch, c.fx, c.fy, c.cx, c.cy, self.near, c.width, c.height, self._records,
            self.outlines, self._counts,
        )  # fmt: skip
        self.kernels["scan_tiles"](
            1, 1024, self.views * self.tiles, self.room or UNLIMITED, self._counts, self._offsets,
            self._cursor, self.status,
        )  # fmt: skip

    def entries(self) -> int:
        """How many entries the last projection made; waits for it."""
        return int(self.status[0])

    def blend(self, views: Views) -> Maps:
        """List and sort the entries, composite the maps."""
        c = self.camera
        self.kernels["list_disks"](
            (self.blocks, self.views), THREADS, self.capacity, views.count, self._records,
            self.outlines, c.width, c.height, self.room, self._cursor, self._keys,
        )  # fmt: skip
        self.kernels["sort_tiles"](
            self.views * self.tiles, THREADS, self.room, self._offsets, self._keys, self._disks
        )
        m = self.maps
        self.kernels["blend_tiles"](
            (self.tiles, self.views), THREADS, self.capacity, self._records, self.outlines,
            self._offsets, self._disks, self.room, 1 / self.near, c.width, c.height, m.depth,
            m.normal, m.alpha, m.distortion, m.median_depth, self._saved, self._ranks, m.visible,
        )  # fmt: skip
        return m

    def unblend(self, gradients: MapGradients, sums: Float[Tensor, "b n 16"]) -> None:
        """Add the gradients of all records to ``sums``."""
        c, d = self.camera, gradients
        area = c.width * c.height
        strides = (1, area) if d.normal.shape[1:] == (3, c.height, c.width) else (3, 1)
        self.kernels["unblend_tiles"](
            (self.tiles, self.views), THREADS, self.capacity, self._records, self.outlines,
            self._offsets, self._disks, self.room, 1 / self.near, c.width, c.height, self._saved,
            self._ranks, d.depth, d.normal, *strides, d.alpha, d.distortion, sums,
        )  # fmt: skip

    def project_backward(
        self,
        disks: DiskParameters,
        views: Views,
        sums: Float[Tensor, "b n 16"],
        d_disks: DiskParameters | None,
        d_poses: Float[Tensor, "k b 16"] | None,
    ) -> None:
        """Write the gradients of the disks and add those of the poses, where they are asked for.

        The poses' come in POSE_COPIES parts to be summed, 12 numbers of each 16.
        """
        c = self.camera
        self.kernels["project_backward"](
            self.blocks, THREADS, self.capacity, views.count, self.views, *disks, views.poses,
            views.batch, c.fx, c.fy, self.outlines, sums, *(d_disks or [None] * 4), d_poses,
        )  # fmt: skip


def empty_disks(capacity: int, device: torch.device) -> DiskParameters:
    """Uninitialised parameters in one piece of memory."""
    flat = torch.empty(10 * capacity, device=device)
    parts = flat.split([3 * capacity, 4 * capacity, 2 * capacity, capacity])
    n = capacity
    return DiskParameters(parts[0].view(n, 3), parts[1].view(n, 4), parts[2].view(n, 2), parts[3])


@dataclass(slots=True)
class Trace:
    """What a forward pass leaves for its backward pass."""

    disks: DiskParameters
    views: Views
    rasterizer: Rasterizer


def rasterize_forward(
    disks: DiskParameters,
    camera: Camera,
    poses: Float[Tensor, "b 3 4"],
    near: float,
    with_trace: bool = True,
) -> tuple[Maps, Trace]:
    """Render the disks from all poses (float64, world to camera) in one launch of each kernel.

    All tensors lie on one GPU; the parameters are contiguous float32. The number of list entries is
    read back once, which waits for the projection but not for the compositing.
    """
    views = Views(poses)
    rasterizer = Rasterizer(
        len(disks.position), len(poses), camera, near, disks.position.device, with_trace
    )
    rasterizer.project(disks, views)
    rasterizer.reserve(rasterizer.entries())
    return rasterizer.blend(views), Trace(disks, views, rasterizer)


def rasterize_backward(trace: Trace, gradients: MapGradients, with_poses: bool = True) -> Gradients:
    """Gradients of a loss, summed over the views, given those of its maps."""
    r = trace.rasterizer
    device = r.outlines.device
    sums = torch.zeros(r.views, r.capacity, SUMS, device=device)
    r.unblend(gradients, sums)
    d_disks, copies = empty_disks(r.capacity, device), None
    if with_poses:
        copies = torch.zeros(POSE_COPIES, r.views, 16, dtype=torch.float64, device=device)
    r.project_backward(trace.disks, trace.views, sums, d_disks, copies)
    poses = None if copies is None else copies.sum(0)[:, :12].unflatten(1, (3, 4))
    return Gradients(d_disks, poses)
