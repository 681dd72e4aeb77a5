"""The renderer's two passes on plain arrays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.splat.cpu.binning import DIGIT_BITS, DIGITS, cut_disks, list_disks, sort_by_digit
from geogs.splat.cpu.blend import BLEND_PLANES, blend_tiles
from geogs.splat.cpu.blend_backward import UNBLEND_PLANES, unblend_tiles
from geogs.splat.cpu.layout import (
    GRADIENT,
    OUTLINE,
    PLANE,
    RECORD,
    SAVED,
    TILE_HEIGHT,
    TILE_PIXELS,
    TILE_WIDTH,
    WC,
)
from geogs.splat.cpu.project import project_disks
from geogs.splat.cpu.project_backward import project_disks_backward, sum_pairs
from geogs.splat.protocols import Backward
from geogs.threads import run_chunks, worker_count
from geogs.world.disks import DiskParameters

# More chunks than threads, so that threads finish together; neighbouring tiles share a chunk, and
# with it the disks in the cache. One thread waits for no other.
_TILE_CHUNKS_PER_THREAD = 16
# The pose gradient is summed per chunk, then over chunks: their number must not depend on threads.
_DISK_CHUNKS = 8

Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""position (n, 3), quaternion (n, 4), log_scale (n, 2), opacity_logit (n): float32, contiguous."""
Maps = tuple[np.ndarray, ...]
"""Depth, normal (h, w, 3), alpha, distortion, median depth: float32 (h, w); visible: bool (n)."""


@dataclass(slots=True)
class TileLists:
    """The disks of each tile, nearest first."""

    offsets: np.ndarray
    """(tiles + 1,) index of each tile's first entry."""
    disks: np.ndarray
    """(entries,) index of the disk."""
    runs: np.ndarray
    """(entries, 2) runs of the tile's pixels that the disk may reach."""
    slots: np.ndarray
    """(n + 1,) index of each disk's first pair."""
    entries: np.ndarray
    """(pairs,) the entry of each pair; the number of entries where the disk misses the tile."""


@dataclass(slots=True)
class Trace:
    """State that a forward pass leaves for its backward pass alone."""

    parameters: Arrays
    T_cw: np.ndarray
    intrinsics: tuple[float, float, float, float]
    inverse_near: np.float32
    records: np.ndarray
    lists: TileLists
    saved: np.ndarray


def rasterize_forward(
    parameters: Arrays,
    camera: Camera,
    T_cw: np.ndarray,
    near: float,
    threads: int,
    with_trace: bool = True,
) -> tuple[Maps, Trace]:
    """Render the disks; ``T_cw`` is (3, 4) float64.

    The result is the same, bit by bit, for any number of threads. Without trace a backward pass is
    not possible.
    """
    n = len(parameters[0])
    width = camera.width
    height = camera.height
    intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
    records, outlines = np.empty((n, RECORD), np.float32), np.empty((n, OUTLINE))
    boxes, pairs = np.empty((n, 4), np.int32), np.empty(n, np.int32)
    run_chunks(
        lambda c: project_disks(
            *parameters, T_cw, intrinsics, near, width, height, *_span(n, c, _DISK_CHUNKS),
            records, outlines, boxes, pairs,
        ),
        _DISK_CHUNKS, threads,
    )  # fmt: skip
    lists = list_tiles(records, outlines, boxes, pairs, width, height, threads)
    shape = (height, width)
    tiles = len(lists.offsets) - 1
    planes = shape, (*shape, 3), shape, shape, shape
    maps = (*(np.empty(plane, np.float32) for plane in planes), np.zeros(n, np.bool_))
    saved = np.empty((tiles if with_trace else 0, SAVED, TILE_PIXELS), np.float32)
    inverse_near = np.float32(1 / near)
    chunks = _tile_chunks(threads)
    run_chunks(
        lambda c: blend_tiles(
            *_span(tiles, c, chunks), records, lists.offsets, lists.disks, lists.runs, inverse_near,
            *maps, saved, _cache_aligned(BLEND_PLANES * PLANE),
        ),
        chunks, threads,
    )  # fmt: skip
    return maps, Trace(parameters, T_cw, intrinsics, inverse_near, records, lists, saved)


def rasterize_backward(
    trace: Trace,
    d_depth: np.ndarray,
    d_normal: np.ndarray,
    d_alpha: np.ndarray,
    d_distortion: np.ndarray,
    threads: int,
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Gradients of a loss, given its contiguous float32 gradients with respect to the maps: of the
    four arrays of the disks, float32, and of the upper three rows of the pose, float64."""
    lists, n, tiles = trace.lists, len(trace.parameters[0]), len(trace.lists.offsets) - 1
    gradients = np.empty((len(lists.disks) + 1, GRADIENT), np.float32)
    gradients[-1] = 0
    chunks = _tile_chunks(threads)
    run_chunks(
        lambda c: unblend_tiles(
            *_span(tiles, c, chunks), trace.records, lists.offsets, lists.disks, lists.runs,
            trace.inverse_near, trace.saved, d_depth, d_normal, d_alpha, d_distortion, gradients,
            _cache_aligned(UNBLEND_PLANES * PLANE),
        ),
        chunks, threads,
    )  # fmt: skip
    out = tuple(np.empty_like(array) for array in trace.parameters)
    sums, d_T = np.empty((n, GRADIENT), np.float32), np.zeros((_DISK_CHUNKS, 3, 4))

    def finish(chunk: int) -> None:
        span = _span(n, chunk, _DISK_CHUNKS)
        sum_pairs(lists.slots, lists.entries, gradients, *span, sums)
        position, quaternion, log_scale, _ = trace.parameters
        project_disks_backward(
            position, quaternion, log_scale, trace.T_cw, trace.intrinsics, trace.records,
            lists.slots, sums, *span, *out, d_T[chunk],
        )  # fmt: skip

    run_chunks(finish, _DISK_CHUNKS, threads)
    return out, d_T.sum(0)


def list_tiles(
    records: np.ndarray,
    outlines: np.ndarray,
    boxes: np.ndarray,
    pairs: np.ndarray,
    width: int,
    height: int,
    threads: int,
) -> TileLists:
    """Sort the projected disks by depth and assign them to tiles."""
    n = len(pairs)
    columns = -(-width // TILE_WIDTH)
    rows = -(-height // TILE_HEIGHT)
    slots = np.zeros(n + 1, np.int64)
    np.cumsum(pairs, out=slots[1:])
    counts = np.zeros((_DISK_CHUNKS, columns * rows), np.int64)
    pair_runs = np.empty((slots[-1], 2), np.uint8)
    run_chunks(
        lambda c: cut_disks(
            boxes, outlines, slots, columns, *_span(n, c, _DISK_CHUNKS), pair_runs, counts[c]
        ),
        _DISK_CHUNKS,
        threads,
    )
    offsets = np.zeros(columns * rows + 1, np.int64)
    np.cumsum(counts.sum(0), out=offsets[1:])
    order, cursor = sort_by_depth(records, pairs), offsets[:-1].copy()
    disks, runs = np.empty(offsets[-1], np.int32), np.empty((offsets[-1], 2), np.uint8)
    entries = np.empty(slots[-1], np.int32)
    run_chunks(
        lambda c: list_disks(
            order, boxes, slots, pair_runs, columns, *_span(rows, c, threads), cursor, disks, runs,
            entries,
        ),
        threads, threads,
    )  # fmt: skip
    return TileLists(offsets, disks, runs, slots, entries)


def sort_by_depth(records: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Disks that touch a tile, nearest centre first; equal depths keep their order.

    Radix sort of the depths' bit patterns, which order like the positive floats they encode.
    """
    order = np.flatnonzero(pairs).astype(np.int32)
    keys = (1 / records[order, WC]).view(np.uint32)
    other_keys = np.empty_like(keys)
    other_order = np.empty_like(order)
    starts = np.empty(DIGITS + 1, np.int64)
    for shift in range(0, 32, DIGIT_BITS):
        sort_by_digit(keys, order, np.uint32(shift), starts, other_keys, other_order)
        keys, other_keys, order, other_order = other_keys, keys, other_order, order
    return order


def _tile_chunks(threads: int) -> int:
    return 1 if threads == 1 else threads * _TILE_CHUNKS_PER_THREAD


def _span(count: int, chunk: int, chunks: int) -> tuple[int, int]:
    return count * chunk // chunks, count * (chunk + 1) // chunks


def _cache_aligned(count: int) -> np.ndarray:
    """Uninitialised float32 array that starts on a cache line."""
    raw = np.empty(4 * count + 64, np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + 4 * count].view(np.float32)


def rendered(
    disks: DiskParameters, camera: Camera, T_cw: Float[Tensor, "4 4"], near: float, with_trace: bool
) -> tuple[tuple[Tensor, ...], Backward]:
    """Maps of one pose, as in ``RenderOutput``, and their backward pass.

    The backward pass takes the gradients of depth, normal, alpha and distortion, None for zero, and
    returns those of the disks and, float64, of the pose. It may be called again, not without trace.
    """
    x, q, scale, logit = (p.detach().contiguous().numpy() for p in disks)
    pose = T_cw.detach()[:3].to("cpu", torch.float64).contiguous().numpy()
    threads = worker_count()
    maps, trace = rasterize_forward((x, q, scale, logit), camera, pose, near, threads, with_trace)
    shown = tuple(map(torch.from_numpy, maps))
    shapes = [m.shape for m in shown[:4]]  # not the maps, which belong to the graph

    def back(
        gradients: Sequence[Tensor | None], with_pose: bool
    ) -> tuple[DiskParameters, Float[Tensor, "4 4"]]:
        depth, normal, alpha, distortion = (
            (torch.zeros(shape) if g is None else g).to(torch.float32).contiguous().numpy()
            for g, shape in zip(gradients, shapes, strict=True)
        )
        d_disks, rows = rasterize_backward(trace, depth, normal, alpha, distortion, threads)
        d_T = torch.zeros(4, 4, dtype=torch.float64)
        d_T[:3] = torch.from_numpy(rows)
        return DiskParameters(*map(torch.from_numpy, d_disks)), d_T

    return shown, back
