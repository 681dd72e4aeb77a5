"""Lists of the disks in each tile, sorted by depth."""

import math

import numba
import numpy as np

from geogs.kernel_parts import inlined
from geogs.splat.cpu import layout as at
from geogs.splat.cpu.layout import MARGIN, PER_DISK, ROWS_PER_RUN, TILE_HEIGHT, TILE_WIDTH

DIGIT_BITS = 11
DIGITS = 1 << DIGIT_BITS
_DIGIT = np.uint32(DIGITS - 1)


@numba.njit(**PER_DISK)
def sort_by_digit(keys, order, shift, starts, sorted_keys, sorted_order):
    """One pass of a stable radix sort: by the bits of the keys from ``shift`` on."""
    for d in range(DIGITS + 1):
        starts[d] = 0
    for k in range(keys.shape[0]):
        starts[((keys[k] >> shift) & _DIGIT) + 1] += 1
    for d in range(DIGITS):
        starts[d + 1] += starts[d]
    for k in range(keys.shape[0]):
        d = (keys[k] >> shift) & _DIGIT
        sorted_keys[starts[d]] = keys[k]
        sorted_order[starts[d]] = order[k]
        starts[d] += 1


@numba.njit(**inlined(PER_DISK))
def rows_within(outline, left, right):
    """Lowest and highest y of an outline's part with left <= x <= right."""
    lowest = np.inf
    highest = -np.inf
    middle_x = outline[at.MIDDLE_X]
    half_x = outline[at.HALF_X]
    low, high = max(left - middle_x, -half_x), min(right - middle_x, half_x)
    if low <= high:
        x = min(max(outline[at.TOP], low), high)
        side = outline[at.SIDE] * math.sqrt(max(1 - x * x / (half_x * half_x), 0.0))
        highest = outline[at.MIDDLE_Y] + outline[at.SLOPE] * x + side
        x = min(max(-outline[at.TOP], low), high)
        side = outline[at.SIDE] * math.sqrt(max(1 - x * x / (half_x * half_x), 0.0))
        lowest = outline[at.MIDDLE_Y] + outline[at.SLOPE] * x - side
    aside = max(left - outline[at.CENTER_X], outline[at.CENTER_X] - right, 0.0)
    if aside < outline[at.BLUR]:
        half = math.sqrt(outline[at.BLUR] * outline[at.BLUR] - aside * aside)
        lowest = min(lowest, outline[at.CENTER_Y] - half)
        highest = max(highest, outline[at.CENTER_Y] + half)
    return lowest - MARGIN, highest + MARGIN


@numba.njit(**PER_DISK)
def cut_disks(boxes, outlines, slots, columns, start, stop, pair_runs, counts):
    """Cut the disks start..stop along the tiles.

    ``pair_runs`` receives for every pair the runs (first, last) of the tile's pixels that the disk
    may reach, (0, 0) if it misses the tile; ``counts`` the number of disks in each tile. Disk i's
    pairs start at ``slots[i]`` and go through its box row by row.
    """
    for i in range(start, stop):
        if slots[i] == slots[i + 1]:
            continue
        y0, y1 = boxes[i, 2], boxes[i, 3]
        first_row = y0 // TILE_HEIGHT
        last_row = (y1 - 1) // TILE_HEIGHT + 1
        first_column = boxes[i, 0] // TILE_WIDTH
        last_column = (boxes[i, 1] - 1) // TILE_WIDTH + 1
        for col in range(first_column, last_column):
            left = col * TILE_WIDTH
            lowest, highest = rows_within(outlines[i], left, left + TILE_WIDTH - 1)
            low = math.ceil(max(lowest, y0))
            high = math.floor(min(highest, y1 - 1)) + 1
            slot = slots[i] + col - first_column
            for row in range(first_row, last_row):
                first = max(low - row * TILE_HEIGHT, 0)
                last = min(high - row * TILE_HEIGHT, TILE_HEIGHT)
                if first < last:
                    pair_runs[slot, 0] = first // ROWS_PER_RUN
                    pair_runs[slot, 1] = (last + ROWS_PER_RUN - 1) // ROWS_PER_RUN
                    counts[row * columns + col] += 1
                else:
                    pair_runs[slot, 0] = 0
                    pair_runs[slot, 1] = 0
                slot += last_column - first_column


@numba.njit(**PER_DISK)
def list_disks(
    order, boxes, slots, pair_runs, columns, first_row, last_row, cursor, lists, runs, entries
):
    """Fill the lists of the tiles in rows first_row..last_row, nearest disk first.

    ``cursor`` is the index of each tile's next entry: its disk goes to ``lists``, its runs to
    ``runs``. ``entries`` receives the entry of every pair: one past the last where there is none.
    """
    none = lists.shape[0]
    for k in range(order.shape[0]):
        i = order[k]
        top, bottom = boxes[i, 2] // TILE_HEIGHT, (boxes[i, 3] - 1) // TILE_HEIGHT + 1
        first_column = boxes[i, 0] // TILE_WIDTH
        last_column = (boxes[i, 1] - 1) // TILE_WIDTH + 1
        for row in range(max(top, first_row), min(bottom, last_row)):
            slot = slots[i] + (row - top) * (last_column - first_column)
            for t in range(row * columns + first_column, row * columns + last_column):
                entry = none
                if pair_runs[slot, 1] > 0:
                    entry = cursor[t]
                    cursor[t] += 1
                    lists[entry] = i
                    runs[entry, 0] = pair_runs[slot, 0]
                    runs[entry, 1] = pair_runs[slot, 1]
                entries[slot] = entry
                slot += 1
