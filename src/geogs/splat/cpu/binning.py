"""Which tile sees which disks, in which order."""

import math

import numba
import numpy as np

from geogs.splat.cpu.layout import PER_DISK, ROWS_PER_RUN, TILE_HEIGHT, TILE_WIDTH, WC

_DIGIT_BITS = 11
_DIGITS = 1 << _DIGIT_BITS


@numba.njit(**PER_DISK)
def sort_by_depth(records, pairs):
    """Indices of the disks that touch a tile, nearest centre first; equal depths keep their order.

    A radix sort of the depths' bit patterns, which order like the positive floats they encode.
    """
    n = np.count_nonzero(pairs)
    keys, order = np.empty(n, np.uint32), np.empty(n, np.int32)
    count = 0
    for i in range(pairs.shape[0]):
        if pairs[i] > 0:
            depth = np.float32(1) / records[i, WC]
            keys[count] = np.float32(depth).view(np.uint32)
            order[count] = i
            count += 1
    other_keys, other_order = np.empty(n, np.uint32), np.empty(n, np.int32)
    for shift in range(0, 32, _DIGIT_BITS):
        starts = np.zeros(_DIGITS + 1, np.int64)
        for k in range(n):
            starts[((keys[k] >> np.uint32(shift)) & np.uint32(_DIGITS - 1)) + 1] += 1
        for d in range(_DIGITS):
            starts[d + 1] += starts[d]
        for k in range(n):
            d = (keys[k] >> np.uint32(shift)) & np.uint32(_DIGITS - 1)
            other_keys[starts[d]] = keys[k]
            other_order[starts[d]] = order[k]
            starts[d] += 1
        keys, other_keys = other_keys, keys
        order, other_order = other_order, order
    return order


@numba.njit(**PER_DISK)
def count_pairs(pairs, boxes, columns, slots, offsets):
    """First slot of every disk's pairs, and first list entry of every tile."""
    slots[0] = 0
    offsets[:] = 0
    for i in range(pairs.shape[0]):
        slots[i + 1] = slots[i] + pairs[i]
        if pairs[i] > 0:
            for row in range(boxes[i, 2] // TILE_HEIGHT, (boxes[i, 3] - 1) // TILE_HEIGHT + 1):
                for col in range(boxes[i, 0] // TILE_WIDTH, (boxes[i, 1] - 1) // TILE_WIDTH + 1):
                    offsets[row * columns + col + 1] += 1
    for t in range(offsets.shape[0] - 1):
        offsets[t + 1] += offsets[t]


@numba.njit(**{**PER_DISK, "cache": False})
def rows_within(outline, left, right):
    """Rows (lowest, highest, as numbers) of an outline's part with left <= x <= right."""
    lowest, highest = np.inf, -np.inf
    mx, my, blur, ox, oy, hx = outline[0], outline[1], outline[2], outline[3], outline[4], outline[5]
    low, high = max(left - ox, -hx), min(right - ox, hx)
    if low <= high:
        slope, side, top = outline[6], outline[7], outline[8]
        x = min(max(top, low), high)
        highest = oy + slope * x + side * math.sqrt(max(1 - x * x / (hx * hx), 0.0))
        x = min(max(-top, low), high)
        lowest = oy + slope * x - side * math.sqrt(max(1 - x * x / (hx * hx), 0.0))
    aside = max(left - mx, mx - right, 0.0)
    if aside < blur:
        half = math.sqrt(blur * blur - aside * aside)
        lowest, highest = min(lowest, my - half), max(highest, my + half)
    return lowest, highest


@numba.njit(**PER_DISK)
def list_disks(order, boxes, outlines, columns, offsets, first_row, last_row, lists, runs):
    """Fill the lists of the tiles in rows first_row..last_row, nearest disk first.

    An entry is a disk and the runs of the tile's pixels (first, last) that it may reach.
    """
    cursor = offsets[first_row * columns : last_row * columns].copy()
    for k in range(order.shape[0]):
        i = order[k]
        y0, y1 = boxes[i, 2], boxes[i, 3]
        first, last = max(y0 // TILE_HEIGHT, first_row), min((y1 - 1) // TILE_HEIGHT + 1, last_row)
        if first >= last:
            continue
        for col in range(boxes[i, 0] // TILE_WIDTH, (boxes[i, 1] - 1) // TILE_WIDTH + 1):
            left = col * TILE_WIDTH
            lowest, highest = rows_within(outlines[i], left, left + TILE_WIDTH - 1)
            low = int(math.ceil(max(lowest - 0.01, y0)))
            high = int(math.floor(min(highest + 0.01, y1 - 1))) + 1
            for row in range(first, last):
                t = (row - first_row) * columns + col
                top = row * TILE_HEIGHT
                lists[cursor[t]] = i
                runs[cursor[t], 0] = max(low - top, 0) // ROWS_PER_RUN
                runs[cursor[t], 1] = (
                    max(min(high - top, TILE_HEIGHT), 0) + ROWS_PER_RUN - 1
                ) // ROWS_PER_RUN
                cursor[t] += 1
