"""The passes of the renderer on a GPU."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.gpu.kernels import kernels_for
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

    @property
    def pose_size(self) -> int:
        """Count of numbers from one pose to the next."""
        return self.poses.stride(0)


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
        shape = (*views, camera.height, camera.width)
        return Maps(
            depth=torch.empty(shape, device=device),
            normal=torch.empty((*views, 3, camera.height, camera.width), device=device),
            alpha=torch.empty(shape, device=device),
            distortion=torch.empty(shape, device=device),
            median_depth=torch.empty(shape, device=device),
            visible=torch.empty(disks, dtype=torch.bool, device=device),
        )


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
        self.capacity, self.views, self.camera, self.near = capacity, views, camera, near
        self.device = device
        self._kernels = kernels_for(SOURCE, device)
        self._tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
        self._blocks = -(-capacity // THREADS)
        tiles, pixels = views * self._tiles, views * camera.height * camera.width
        counts = torch.zeros(2 + tiles, dtype=torch.int32, device=device)
        self.status, self._counts = counts[:2], counts[2:]
        """Status: most entries of any pass so far; 1 once there was no room for all of them."""
        places = torch.empty(2 * tiles + 1, dtype=torch.int32, device=device)
        self._offsets, self._cursor = places[: tiles + 1], places[tiles + 1 :]
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
            views.pose_size, views.batch, c.fx, c.fy, c.cx, c.cy, self.near, c.width, c.height,
            self._records, self._outlines, self._counts, maps.visible,
        )  # fmt: skip
        self._kernels["scan_tiles"](
            1, 1024, self.views * self._tiles, self.room, self._counts, self._offsets,
            self._cursor, self.status, self._entries,
        )  # fmt: skip

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
            views.pose_size, views.batch, c.fx, c.fy, self._outlines, self._sums,
            *(d_disks or (None,) * 4), None if d_poses is None else self._pose_copies,
        )  # fmt: skip
        if d_poses is not None:
            self._kernels["sum_poses"](self.views, 32, self.views, self._pose_copies, d_poses)
