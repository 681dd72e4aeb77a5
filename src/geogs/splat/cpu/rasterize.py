"""The renderer's two passes on plain arrays."""

from dataclasses import dataclass

import numpy as np

from geogs.geometry.camera import Camera
from geogs.splat.cpu.binning import count_pairs, list_disks, sort_by_depth
from geogs.splat.cpu.blend import blend_tiles
from geogs.splat.cpu.blend_backward import unblend_tiles
from geogs.splat.cpu.layout import (
    GRADIENT,
    OUTLINE,
    RECORD,
    SAVED,
    TILE_HEIGHT,
    TILE_PIXELS,
    TILE_WIDTH,
)
from geogs.splat.cpu.pool import run_chunks
from geogs.splat.cpu.project import project_disks
from geogs.splat.cpu.project_backward import project_disks_backward

_CHUNKS_PER_THREAD = 8
# Disk chunks do not depend on the number of threads: the pose gradient sums them in their order.
_DISK_CHUNKS = 8


@dataclass(slots=True)
class Maps:
    """A rendering: float32 (h, w) arrays, (h, w, 3) for the normal, and bool (n,) visibility."""

    depth: np.ndarray
    normal: np.ndarray
    alpha: np.ndarray
    distortion: np.ndarray
    median_depth: np.ndarray
    visible: np.ndarray


@dataclass(slots=True)
class Trace:
    """What a forward pass leaves for its backward pass; belongs to that pass alone."""

    parameters: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    T_cw: np.ndarray
    intrinsics: tuple[float, float, float, float]
    inverse_near: np.float32
    records: np.ndarray
    boxes: np.ndarray
    slots: np.ndarray
    offsets: np.ndarray
    lists: np.ndarray
    runs: np.ndarray
    saved: np.ndarray


@dataclass(slots=True)
class Gradients:
    """Of the four parameter arrays, float32, and of the upper three rows of T_cw, float64."""

    position: np.ndarray
    quaternion: np.ndarray
    log_scale: np.ndarray
    opacity_logit: np.ndarray
    T_cw: np.ndarray


def rasterize_forward(
    parameters: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    camera: Camera,
    T_cw: np.ndarray,
    near: float,
    threads: int,
    with_trace: bool = True,
) -> tuple[Maps, Trace]:
    """Render; arrays are contiguous float32 (T_cw: (3, 4) float64) as in ``DiskParameters``.

    Results do not depend on the number of threads. Without trace there is no way back, and less
    memory is touched.
    """
    n, width, height = len(parameters[0]), camera.width, camera.height
    intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
    records, boxes = np.empty((n, RECORD), np.float32), np.empty((n, 4), np.int32)
    outlines, pairs = np.empty((n, OUTLINE)), np.empty(n, np.int32)
    run_chunks(
        lambda c: project_disks(
            *parameters, T_cw, intrinsics, near, width, height,
            *_span(n, c, _DISK_CHUNKS), records, outlines, boxes, pairs,
        ),
        _DISK_CHUNKS, threads,
    )  # fmt: skip
    columns, rows = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    slots, offsets = np.empty(n + 1, np.int64), np.empty(columns * rows + 1, np.int64)
    count_pairs(pairs, boxes, columns, slots, offsets)
    order = sort_by_depth(records, pairs)
    lists, runs = np.empty(offsets[-1], np.int32), np.empty((offsets[-1], 2), np.uint8)
    run_chunks(
        lambda c: list_disks(
            order, boxes, outlines, columns, offsets, *_span(rows, c, threads), lists, runs
        ),
        threads, threads,
    )  # fmt: skip
    maps = Maps(
        depth=np.empty((height, width), np.float32),
        normal=np.empty((height, width, 3), np.float32),
        alpha=np.empty((height, width), np.float32),
        distortion=np.empty((height, width), np.float32),
        median_depth=np.empty((height, width), np.float32),
        visible=np.zeros(n, np.bool_),
    )
    saved = np.empty((columns * rows if with_trace else 0, SAVED, TILE_PIXELS), np.float32)
    inverse_near = np.float32(1 / near)
    chunks = threads * _CHUNKS_PER_THREAD
    run_chunks(
        lambda c: blend_tiles(
            c, chunks, records, offsets, lists, runs, inverse_near, maps.depth, maps.normal,
            maps.alpha, maps.distortion, maps.median_depth, maps.visible, saved,
        ),
        chunks, threads,
    )  # fmt: skip
    return maps, Trace(
        parameters, T_cw, intrinsics, inverse_near, records, boxes, slots, offsets, lists, runs, saved
    )


def rasterize_backward(
    trace: Trace,
    d_depth: np.ndarray,
    d_normal: np.ndarray,
    d_alpha: np.ndarray,
    d_distortion: np.ndarray,
    threads: int,
) -> Gradients:
    """Gradients of a loss, given its contiguous float32 gradients with respect to the maps."""
    position, quaternion, log_scale, opacity_logit = trace.parameters
    pair_gradients = np.empty((len(trace.lists), GRADIENT), np.float32)
    chunks = threads * _CHUNKS_PER_THREAD
    run_chunks(
        lambda c: unblend_tiles(
            c, chunks, trace.records, trace.boxes, trace.slots, trace.offsets, trace.lists, trace.runs,
            trace.inverse_near, trace.saved, d_depth, d_normal, d_alpha, d_distortion,
            pair_gradients,
        ),
        chunks, threads,
    )  # fmt: skip
    out = tuple(np.empty_like(p) for p in trace.parameters)
    d_T = np.zeros((_DISK_CHUNKS, 3, 4))
    run_chunks(
        lambda c: project_disks_backward(
            position, quaternion, log_scale, trace.T_cw, trace.intrinsics, trace.records,
            trace.slots, pair_gradients, *_span(len(position), c, _DISK_CHUNKS), *out, d_T[c],
        ),
        _DISK_CHUNKS, threads,
    )  # fmt: skip
    return Gradients(*out, d_T.sum(0))


def _span(count: int, chunk: int, chunks: int) -> tuple[int, int]:
    return count * chunk // chunks, count * (chunk + 1) // chunks
