"""Truncated signed distances of depth maps in sparse blocks of 8 x 8 x 8 voxels.

Curless and Levoy 1996, in blocks allocated where surface was seen (voxel hashing, Niessner 2013).
Blocks are found by binary search in their sorted keys, in plain batched torch on any device; the
voxels are updated by a kernel of the device.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.gpu.kernels import kernels_for
from geogs.mesh.volume.contraction import UNCONTRACTED, Contraction
from geogs.mesh.volume.pixel_planes import PixelPlanes
from geogs.threads import run_chunks, worker_count

BLOCK = 8
"""Voxels along a side of a block."""
LIMIT = 2**19
"""Voxels have coordinates in [-LIMIT, LIMIT) along each axis; others are left out."""
BYTES_PER_BLOCK = BLOCK**3 * 2 * 4
HALF = BLOCK // 2
"""Voxels along a side of half a block."""
_BITS = 20
_CHUNK = 256
"""Blocks that a thread takes at a time."""
_SOURCE = Path(__file__).parent / "cuda" / "tsdf.cu"


@dataclass(frozen=True)
class BlockBox:
    """A part of the space, in coordinates of blocks."""

    low: tuple[int, int, int]
    high: tuple[int, int, int]
    """First block beyond it along each axis."""


def pack(coordinates: Int[Tensor, "*n 3"]) -> Int[Tensor, "*n"]:
    """One sortable key of integer coordinates in [-2^20, 2^20)."""
    x, y, z = (coordinates.long() + 2**_BITS).unbind(-1)
    return (((x << (_BITS + 1)) + y) << (_BITS + 1)) + z


def unpack(keys: Int[Tensor, "n"]) -> Int[Tensor, "n 3"]:
    """The coordinates of :func:`pack`."""
    mask = 2 ** (_BITS + 1) - 1
    parts = [keys >> (2 * (_BITS + 1)), (keys >> (_BITS + 1)) & mask, keys & mask]
    return torch.stack(parts, -1) - 2**_BITS


def band_blocks(
    points: Float[Tensor, "n 3"], voxel: float, truncation: float
) -> Int[Tensor, "k 3"]:
    """Coordinates of every block that comes within the truncation of a point of contracted space.

    Points are first gathered into half blocks, whose neighbours in reach of the truncation cover
    the band around all of their points. ``truncation`` is in voxels. Points at :data:`LIMIT`
    voxels from the origin or farther are left out.
    """
    cell = torch.floor(points / (voxel * HALF)).long()
    reach = math.ceil(truncation / HALF)
    cell = cell[(cell.abs() < LIMIT // HALF - reach - 2).all(-1)]
    cell = unpack(torch.unique(pack(cell)))
    low, high = (cell - reach) >> 1, (cell + reach) >> 1
    steps = torch.arange(reach + 1, device=points.device)
    offsets = torch.cartesian_prod(steps, steps, steps)
    blocks = low[:, None] + offsets
    inside = (blocks <= high[:, None]).all(-1)
    return unpack(torch.unique(pack(blocks[inside])))


def blocks_seen(
    planes: PixelPlanes,
    T_cw: Float[Tensor, "4 4"],
    voxel: float,
    truncation: float,
    contraction: Contraction,
) -> Int[Tensor, "k 3"]:
    """Coordinates of the blocks in which the surface of a depth map lies, with its band."""
    return band_blocks(footprint_points(planes, T_cw, voxel, contraction), voxel, truncation)


def footprint_points(
    planes: PixelPlanes, T_cw: Float[Tensor, "4 4"], voxel: float, contraction: Contraction
) -> Float[Tensor, "n 3"]:
    """Points of contracted space along the footprints of the pixels of a depth map, half a block
    apart or less, so that a floor that is seen at a slant has no gaps between the rows of the
    image."""
    points = planes.footprints(voxel * HALF).double()
    return contraction.contracted((points - T_cw[:3, 3]) @ T_cw[:3, :3])


def meets_frustum(
    points: Float[Tensor, "k 3"], radius: Float[Tensor, "k"] | float, camera: Camera, far: float
) -> Bool[Tensor, "k"]:
    """Whether balls around points of the camera's frame meet its view frustum up to ``far``."""
    x, y, z = points.unbind(-1)
    inside = (z > -radius) & (z < far + radius)
    for p, f, c, size in (
        (x, camera.fx, camera.cx, camera.width),
        (y, camera.fy, camera.cy, camera.height),
    ):
        for slope, sign in (((-0.5 - c) / f, 1.0), ((size - 0.5 - c) / f, -1.0)):
            inside &= sign * (p - slope * z) > -radius * (1 + slope**2) ** 0.5
    return inside


class SparseTsdf:
    """Distances and weights of the voxels near observed surfaces.

    Voxel (i, j, k) is the sample at ``voxel * (i, j, k)`` in contracted space, which is that of the
    world frame where there is no contraction. A distance is in units of the truncation, in
    [-1, 1], positive in front of the surface; a weight is the sum of the weights of the
    observations, 0 where the voxel was never seen.
    """

    def __init__(
        self,
        voxel: float,
        truncation: float = 4.0,
        device: torch.device | str = "cpu",
        expected_blocks: int = 1024,
        box: BlockBox | None = None,
        contraction: Contraction = UNCONTRACTED,
    ) -> None:
        """``voxel`` in map units, ``truncation`` in voxels.

        With a ``box`` only its blocks are kept, and one layer beyond its upper sides, into which
        cells on these reach; kept voxels are the same as without the box.
        """
        self.box = box
        self.voxel = voxel
        self.truncation = truncation
        self.contraction = contraction
        self.device = torch.device(device)
        self._keys = torch.empty(0, dtype=torch.long, device=self.device)
        self._slots = torch.empty(0, dtype=torch.long, device=self.device)
        self.coordinates = torch.empty((0, 3), dtype=torch.long, device=self.device)
        """Block coordinates (k, 3); block (a, b, c) begins at voxel 8 (a, b, c)."""
        shape = (max(expected_blocks, 1), BLOCK**3)
        self._distance = torch.ones(shape, device=self.device)
        self._weight = torch.zeros(shape, device=self.device)
        steps = torch.arange(BLOCK, device=self.device)
        self._offsets = torch.cartesian_prod(steps, steps, steps)

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self._keys)

    @property
    def distance(self) -> Float[Tensor, "k 8 8 8"]:
        """Signed distances over truncation, by block and x, y, z; 1 where never seen."""
        return self._distance[: len(self)].unflatten(1, (BLOCK, BLOCK, BLOCK))

    @property
    def weight(self) -> Float[Tensor, "k 8 8 8"]:
        """Sums of observation weights."""
        return self._weight[: len(self)].unflatten(1, (BLOCK, BLOCK, BLOCK))

    def owns(self, block: Int[Tensor, "*b 3"], layers: int = 0) -> Bool[Tensor, "*b"]:
        """Whether blocks lie in the box or ``layers`` layers above it; all do if there is none."""
        if self.box is None:
            return torch.ones(block.shape[:-1], dtype=torch.bool, device=block.device)
        low, high = (block.new_tensor(side) for side in (self.box.low, self.box.high))
        return ((block >= low) & (block < high + layers)).all(-1)

    def slots_of(self, blocks: Int[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
        """Indices of blocks in :attr:`coordinates`, -1 where the volume has none."""
        if not len(self):
            return torch.full(blocks.shape[:-1], -1, device=self.device)
        keys = pack(blocks)
        place = torch.searchsorted(self._keys, keys).clamp(max=len(self) - 1)
        return torch.where(self._keys[place] == keys, self._slots[place], -1)

    def integrate(
        self,
        depth: Float[Tensor, "h w"],
        weight: Float[Tensor, "h w"],
        camera: Camera,
        T_cw: Float[Tensor, "4 4"],
    ) -> None:
        """Average one depth map in.

        Each pixel is a small plane, which is exact on flat surfaces at any slant and does not mix
        the two sides of a depth step. Every voxel of every block in view is updated up to one
        truncation behind the surface, so free space seen later clears what an earlier view put
        there. In the farther half of that the weight falls to zero (Bylow et al. 2013), since space
        behind one view's silhouette is often in front of another's surface. Distances, and the
        truncation, are along the optical axis; the truncation is wider on slanted surfaces
        (``PixelPlanes``), and grows with the voxels where space is contracted.
        """
        depth = depth.to(self.device, torch.float32)
        weight = weight.to(self.device, torch.float32)
        valid = torch.isfinite(depth) & (depth > 0) & (weight > 0)
        if not bool(valid.any()):
            return
        T_cw = T_cw.to(self.device, torch.float64)
        planes = PixelPlanes.of(depth, valid, camera).grown(T_cw, self.contraction)
        seen = blocks_seen(planes, T_cw, self.voxel, self.truncation, self.contraction)
        self._allocate(seen[self.owns(seen, layers=1)])
        if not len(self):
            return
        table = planes.table(weight)
        truncation = planes.truncation(self.truncation * self.voxel)
        far = torch.where(valid, depth + truncation.view_as(depth), 0.0).amax()
        if self.device.type == "cuda":
            self.update_by_kernel(table, truncation, camera, T_cw, far)
            return
        slots = self._in_view(camera, T_cw, float(far))
        self._update(slots, camera, T_cw, table, truncation)

    def update_by_kernel(
        self,
        table: Float[Tensor, "p 4"],
        truncation: Float[Tensor, "p"],
        camera: Camera,
        T_cw: Float[Tensor, "4 4"],
        far: Float[Tensor, ""],
    ) -> None:
        """:meth:`_update` on a GPU, of all blocks in view at once.

        Nothing changes beyond the depth ``far``, which stays on the device.
        """
        c = camera
        kernels_for(_SOURCE, self.device)["integrate"](
            len(self), BLOCK**3, self.coordinates, self._distance, self._weight, table,
            truncation, T_cw.contiguous(), far, c.width, c.height, c.fx, c.fy, c.cx, c.cy,
            self.voxel, *self.contraction.centre, self.contraction.radius,
        )  # fmt: skip

    def _allocate(self, blocks: Int[Tensor, "k 3"]) -> None:
        """Add the blocks that the volume does not have yet."""
        blocks = blocks[self.slots_of(blocks) < 0]
        if not len(blocks):
            return
        old = len(self)
        total = old + len(blocks)
        capacity = len(self._distance)
        if total > capacity:
            extra = (max(total, capacity + capacity // 2) - capacity, BLOCK**3)
            self._distance = torch.cat([self._distance, self._distance.new_ones(extra)])
            self._weight = torch.cat([self._weight, self._weight.new_zeros(extra)])
        slots = torch.arange(old, total, device=self.device)
        self._keys, order = torch.cat([self._keys, pack(blocks)]).sort()
        self._slots = torch.cat([self._slots, slots])[order]
        self.coordinates = torch.cat([self.coordinates, blocks])

    def _in_view(self, camera: Camera, T_cw: Tensor, far: float) -> Int[Tensor, "k"]:
        """Slots of the blocks whose bounding sphere meets the view frustum up to ``far``."""
        side = self.voxel * BLOCK
        middle = (self.coordinates + 0.5).double() * side
        centre, radius = self.contraction.balls(middle, side * 0.5 * 3**0.5)
        points = centre @ T_cw[:3, :3].mT + T_cw[:3, 3]
        return meets_frustum(points, radius, camera, far).nonzero()[:, 0]

    def _update(
        self,
        slots: Int[Tensor, "k"],
        camera: Camera,
        T_cw: Float[Tensor, "4 4"],
        table: Float[Tensor, "p 4"],
        truncation: Float[Tensor, "p"],
    ) -> None:
        """Average a depth map into blocks on the CPU; they share no voxel, so threads may."""
        from geogs.mesh.volume.volume_kernels import average_in

        centre = T_cw.new_tensor(self.contraction.centre)[:, None]
        projection = camera.matrix() @ T_cw[:3]
        corner = self.coordinates[slots].double().mT
        rotation = projection[:, :3]
        shift = projection[:, 3:] + projection[:, :3] @ centre
        corner = corner * BLOCK * self.voxel - centre
        steps = self._offsets.double().mT * self.voxel
        block, local = _rows(rotation @ corner + shift), (rotation @ steps).float().numpy()
        distance, weight = self._distance.numpy(), self._weight.numpy()
        planes, reach, number = table.numpy(), truncation.numpy(), slots.numpy()
        apart, away = _rows(corner), steps.float().numpy()
        middle, radius = shift[:, 0].float().numpy(), np.float32(self.contraction.radius)

        def update(chunk: int) -> None:
            some = slice(chunk * _CHUNK, (chunk + 1) * _CHUNK)
            average_in(
                number[some], block[some], local, apart[some], away, middle, radius, planes, reach,
                camera.width, camera.height, distance, weight,
            )  # fmt: skip

        run_chunks(update, -(-len(slots) // _CHUNK), worker_count())


def _rows(columns: Float[Tensor, "3 k"]) -> Float[np.ndarray, "k 3"]:
    return np.ascontiguousarray(columns.mT.float().numpy())
