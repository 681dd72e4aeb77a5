"""What the renderer's kernels work on in one rendering, counted from their own buffers.

The tests and formulas repeat those of ``reaches`` (project.cuh) and ``hit_of`` (blend.cuh).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.splat.render import render
from geogs.world.disks import DiskParameters

TILE, PART_WIDTH, PART_HEIGHT, PARTS, CHUNK = 16, 8, 4, 8, 32
"""Pixels of a tile and of a warp's part of it; entries that a warp tests at once."""
MIN_ALPHA, MAX_ALPHA, MIN_HIT_RATIO = 1 / 255, 0.99, 1e-4
NEVER = 2**30
_AT_ONCE = 2**19


@dataclass(frozen=True)
class Counts:
    """Counts of one view."""

    disks: int
    boxed: int
    """Disks whose outline meets the image."""
    listed: int
    """Different disks in the lists."""
    visible: int
    pixels: int
    tiles: int
    candidates: int
    """Tiles in the boxes of all disks, each to be tested."""
    entries: int
    """Disks in tiles."""
    exchanges: int
    """Exchanges of two keys at most, in the tiles' sorting networks."""
    tests: int
    """Tests of 32 entries for one part of a tile, by the forward pass."""
    hits: int
    """Entries that reach a part whose warp evaluates them in the forward pass."""
    hits_blended: int
    """Hits of which a pixel is blended, in either pass."""
    blended: int
    """Pixels blended, over all disks."""
    backward_tests: int
    """At least; a tile whose parts end at different ranks may need one more in each part."""
    backward_hits: int
    alpha_error: float
    """Largest difference of the map of alpha and the one made of what is counted here: up to 1/255
    where only one of them blends a disk at that threshold."""


@dataclass(frozen=True)
class _Lists:
    """The entries of all tiles in their order, and what the kernels know of each."""

    disk: Int[Tensor, "e"]
    tile: Int[Tensor, "e"]
    rank: Int[Tensor, "e"]
    """Place in the tile's list."""
    records: Float[Tensor, "n 16"]
    outlines: Float[Tensor, "n 8"]
    camera: Camera
    near: float

    @property
    def columns(self) -> int:
        return -(-self.camera.width // TILE)

    def corner(self, entries: slice | Tensor, part: int) -> tuple[Tensor, Tensor]:
        """First pixel of a part of the entries' tiles."""
        tile = self.tile[entries]
        x = tile % self.columns * TILE + (part & 1) * PART_WIDTH
        return x, tile // self.columns * TILE + (part >> 1) * PART_HEIGHT

    def reach(self, entries: slice, part: int) -> Bool[Tensor, "k"]:
        """Which disks reach a part of their tile."""
        disk, (x, y) = self.disk[entries], self.corner(entries, part)
        outline, record = self.outlines[disk], self.records[disk]
        last = (x + PART_WIDTH - 1, y + PART_HEIGHT - 1)
        return reaches(outline, record[:, 0], record[:, 1], x, last[0], y, last[1])

    def alpha(self, entries: Tensor, part: int) -> tuple[Tensor, Tensor, Tensor]:
        """Opacity of disks at the 32 pixels of a part, those pixels' index and which exist."""
        lane = torch.arange(PART_WIDTH * PART_HEIGHT, device=self.disk.device)
        left, top = (v[:, None] for v in self.corner(entries, part))
        x, y = left + lane % PART_WIDTH, top + lane // PART_WIDTH
        exists = (x < self.camera.width) & (y < self.camera.height)
        alpha = opacity(self.records[self.disk[entries]], x, y, self.near)
        pixel = torch.where(exists, y * self.camera.width + x, 0)
        return alpha, pixel, exists


def reaches(
    outline: Float[Tensor, "k 8"], mx: Tensor, my: Tensor, x0: Tensor, x1: Tensor, y0: Tensor,
    y1: Tensor,
) -> Bool[Tensor, "k"]:  # fmt: skip
    """``reaches`` of project.cuh."""
    X, Y, A, B, C, radius2 = outline.unbind(1)[:6]
    zero = torch.zeros_like(X)
    ex, ey = torch.maximum(x0 - mx, mx - x1), torch.maximum(y0 - my, my - y1)
    near = ex.clamp(min=0).square() + ey.clamp(min=0).square() <= radius2
    x0, x1, y0, y1 = x0 - X, x1 - X, y0 - Y, y1 - Y
    cx, cy = torch.clamp(zero, x0, x1), torch.clamp(zero, y0, y1)
    y, x = torch.clamp(-B * cx / C, y0, y1), torch.clamp(-B * cy / A, x0, x1)
    across = A * cx * cx + 2 * B * cx * y + C * y * y
    down = A * x * x + 2 * B * x * cy + C * cy * cy
    return near | (torch.minimum(across, down) <= 1.005)


def opacity(
    record: Float[Tensor, "k 16"], x: Int[Tensor, "k 32"], y: Int[Tensor, "k 32"], near: float
) -> Float[Tensor, "k 32"]:
    """``hit_of`` of blend.cuh, of which the opacity alone."""
    mx, my, ux, uy, vx, vy, wx, wy, wc, o = (record[:, i, None] for i in range(10))
    dx, dy = x - mx, y - my
    w = wx * dx + wy * dy + wc
    bounded = w.clamp(max=1 / near).maximum(wc * MIN_HIT_RATIO)
    u, v = (ux * dx + uy * dy) / bounded, (vx * dx + vy * dy) / bounded
    on_disk, blurred = u * u + v * v, dx * dx + dy * dy
    rho = torch.where((bounded == w) & (on_disk <= blurred), on_disk, blurred)
    return o * (-rho).exp()


def part_of_pixels(camera: Camera, device: torch.device) -> Int[Tensor, "h*w"]:
    """Index of the part, eight to a tile, that each pixel lies in."""
    x, y = (
        torch.arange(camera.width, device=device),
        torch.arange(camera.height, device=device)[:, None],
    )
    tile = y // TILE * -(-camera.width // TILE) + x // TILE
    part = y % TILE // PART_HEIGHT * (TILE // PART_WIDTH) + x % TILE // PART_WIDTH
    return (PARTS * tile + part).flatten()


def largest_of_parts(values: Int[Tensor, "p"], part: Int[Tensor, "p"], count: int) -> Tensor:
    """Largest of the pixels' values in each part; 0 where it has no pixel."""
    return torch.zeros(count, dtype=values.dtype, device=values.device).scatter_reduce(
        0, part, values, "amax"
    )


def sorting_exchanges(lengths: Int[Tensor, "t"]) -> int:
    """Compared pairs of the bitonic networks for lists of these lengths, padded ones included."""
    exponent = lengths.clamp(min=1).double().log2().ceil()
    return int((2**exponent / 2 * exponent * (exponent + 1) / 2).sum())


def tiles_in_boxes(outlines: Float[Tensor, "n 8"]) -> tuple[int, Bool[Tensor, "n"]]:
    """Tiles in the disks' boxes in all, and which disks have one."""
    bits = outlines[:, 6:].contiguous().view(torch.int32).long() & 0xFFFFFFFF
    first, last = (bits & 0xFFFF) // TILE, ((bits >> 16) + TILE - 1) // TILE
    return int((last - first).prod(1).sum()), (bits != 0).any(1)


@torch.no_grad()
def count_work(
    disks: DiskParameters, camera: Camera, T_cw: Float[Tensor, "4 4"], near: float
) -> Counts:
    """Render a view and count what the kernels did."""
    with torch.enable_grad():
        leaves = DiskParameters(*(p.detach().clone().requires_grad_() for p in disks))
        out = render(leaves, camera, T_cw, "cuda", near)
    rasterizer = out.depth.grad_fn.loan.rasterizer  # type: ignore[union-attr]
    lengths = rasterizer._offsets.diff().long()
    entries, tiles = int(lengths.sum()), len(lengths)
    tile = torch.arange(tiles, device=lengths.device).repeat_interleave(lengths)
    rank = torch.arange(entries, device=lengths.device) - rasterizer._offsets[tile].long()
    lists = _Lists(
        rasterizer._disks[:entries].long(), tile, rank, rasterizer._records[0],
        rasterizer._outlines[0], camera, near,
    )  # fmt: skip
    candidates, boxed = tiles_in_boxes(lists.outlines)
    sums = _hits(lists, rasterizer._ranks.long(), lengths, out.alpha.flatten())
    return Counts(
        disks=len(boxed), boxed=int(boxed.sum()), listed=len(lists.disk.unique()),
        visible=int(out.visible.sum()), pixels=camera.width * camera.height, tiles=tiles,
        candidates=candidates, entries=entries, exchanges=sorting_exchanges(lengths), **sums,
    )  # fmt: skip


def _hits(
    lists: _Lists, ranks: Int[Tensor, "p"], lengths: Int[Tensor, "t"], alpha: Float[Tensor, "p"]
) -> dict:
    """What has to do with single parts and pixels.

    A pixel blends all opaque enough hits up to its rank; the next one would leave too little light,
    which ends the pixel. A warp ends once all its pixels have.
    """
    part = part_of_pixels(lists.camera, ranks.device)
    count = PARTS * len(lengths)
    last_rank = largest_of_parts(ranks, part, count)
    end = torch.full_like(ranks, NEVER)
    darkness = torch.zeros_like(alpha, dtype=torch.float64)
    hits_blended = blended = backward_hits = 0
    reached = []
    for first in range(0, len(lists.disk), _AT_ONCE):
        span = slice(first, min(first + _AT_ONCE, len(lists.disk)))
        for k in range(PARTS):
            hit = first + lists.reach(span, k).nonzero()[:, 0]
            rank, own_part = lists.rank[hit], PARTS * lists.tile[hit] + k
            reached.append((rank, own_part))
            opaque, pixel, exists = lists.alpha(hit, k)
            counted = exists & (opaque >= MIN_ALPHA)
            behind = rank[:, None] >= ranks[pixel]
            chosen = counted & ~behind
            blended += int(chosen.sum())
            hits_blended += int(chosen.any(1).sum())
            backward_hits += int((rank < last_rank[own_part]).sum())
            light = torch.log1p(-opaque[chosen].clamp(max=MAX_ALPHA).double())
            darkness.index_add_(0, pixel[chosen], light)
            ended = counted & behind
            ends = rank[:, None].expand_as(pixel)[ended]
            end.scatter_reduce_(0, pixel[ended], ends, "amin")
    last_end = largest_of_parts(end, part, count)
    exists = torch.zeros(count, dtype=torch.bool, device=part.device).index_fill(0, part, True)
    chunks = torch.minimum(-(-lengths.repeat_interleave(PARTS) // CHUNK), last_end // CHUNK + 1)
    chunks = torch.where(exists, chunks, 0)
    hits = sum(int((rank < CHUNK * chunks[own]).sum()) for rank, own in reached)
    return {
        "tests": int(chunks.sum()), "hits": hits, "hits_blended": hits_blended,
        "blended": blended, "backward_tests": int((-(-last_rank // CHUNK)).sum()),
        "backward_hits": backward_hits,
        "alpha_error": float((1 - darkness.exp() - alpha).abs().max()),
    }  # fmt: skip
