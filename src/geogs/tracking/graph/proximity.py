"""Image-based distances between keyframes, and selection of pairs for edges."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.device_choice import keyframe_pairs
from geogs.bundle.keyframe_pairs import LEAST_OVERLAP
from geogs.threads import thread_map
from geogs.tracking.graph.overlap import alike_in_size, may_overlap
from geogs.world.edges import Pair
from geogs.world.keyframes import KeyframeSet

RADIUS = 3
"""Number of preceding keyframes that each is matched with, as in DROID-SLAM."""
PAIRS_TOGETHER = 512, 8192
"""Directed pairs that are projected at a time, on the CPU and on a GPU; bounds memory."""


def frame_distances(
    store: KeyframeSet, directed: Sequence[Pair], rotation_weight: float = 0.3
) -> Float[Tensor, "e"]:
    """Return the distance of directed keyframe pairs in pixels; infinite at little overlap."""
    if not directed:
        return store.grid.pixels.new_zeros(0)
    return keyframe_pairs(store, directed).distances(rotation_weight)


def proximity_pairs(
    store: KeyframeSet,
    later: Sequence[int],
    earlier: Sequence[int],
    existing: Iterable[Pair],
    radius: int,
    suppression: int,
    max_distance: float,
    max_pairs: int,
) -> list[Pair]:
    """Select pairs between ``later`` and ``earlier`` keyframes (DROID-SLAM's proximity factors).

    Every later keyframe is paired with its ``radius`` predecessors. Then pairs of similar image
    scale are taken by growing distance up to ``max_distance`` pixels, each suppressing those within
    ``suppression`` keyframes of it, as the existing pairs do, until there are ``max_pairs``.
    """
    ids = store.ids
    position = {k: n for n, k in enumerate(ids)}
    rows, columns = (np.array(sorted(position[k] for k in part)) for part in (earlier, later))
    # Pairs that end well before the later keyframes suppress none of theirs.
    reach = int(columns.min(initial=len(ids))) - suppression
    taken = {
        (position[i], position[j])
        for i, j in existing
        if i in position and j in position and position[j] >= reach
    }
    found: list[Pair] = []
    for k in later:
        for back in range(1, radius + 1):
            pair = (position[k] - back, position[k])
            if pair[0] >= 0 and pair not in taken:
                taken.add(pair)
                found.append(pair)
    near = _Suppression(rows, columns, suppression)
    for pair in taken:
        near.block(pair)
    free = near.free(rows, columns) & (columns - rows[:, None] > radius)
    for a, b in _by_distance(store, rows, columns, free, max_distance):
        if len(found) >= max_pairs:
            break
        if not near.is_blocked((a, b)):
            found.append((a, b))
            near.block((a, b))
    return [(ids[a], ids[b]) for a, b in found]


def _by_distance(
    store: KeyframeSet,
    rows: Int[np.ndarray, "r"],
    columns: Int[np.ndarray, "c"],
    wanted: Bool[np.ndarray, "r c"],
    max_distance: float,
) -> list[Pair]:
    """Return the wanted pairs of positions that are near enough, by growing distance."""
    ids = store.ids
    first, second = ([ids[k] for k in part.tolist()] for part in (rows, columns))
    if wanted.any():
        wanted = wanted & alike_in_size(store, first, second)
    if int(wanted.sum()) > PAIRS_TOGETHER[0]:
        wanted = wanted & may_overlap(store, first, second, LEAST_OVERLAP)
        wanted &= may_overlap(store, second, first, LEAST_OVERLAP).T
    at = np.stack(np.nonzero(wanted), 1)
    pairs = np.stack([rows[at[:, 0]], columns[at[:, 1]]], 1)

    def distances(part: Int[np.ndarray, "k 2"]) -> Float[np.ndarray, "k"]:
        directed = [(ids[a], ids[b]) for a, b in part.tolist()]
        both = frame_distances(store, directed + [(j, i) for i, j in directed])
        forward, backward = both.chunk(2)
        return ((forward + backward) / 2).cpu().numpy()

    if not len(pairs):
        return []
    size = PAIRS_TOGETHER[store.grid.on_gpu] // 2
    parts = [pairs[k : k + size] for k in range(0, len(pairs), size)]
    found = [distances(p) for p in parts] if store.grid.on_gpu else thread_map(distances, parts)
    distance = np.concatenate(found)
    near = np.nonzero(distance <= max_distance)[0]
    order = near[np.argsort(distance[near], kind="stable")]
    return [(a, b) for a, b in pairs[order].tolist()]


class _Suppression:
    """Suppression of pairs of positions that are too near to an existing one."""

    def __init__(
        self, rows: Int[np.ndarray, "r"], columns: Int[np.ndarray, "c"], reach: int
    ) -> None:
        self._reach = reach
        some = len(rows) and len(columns)
        self._corner = (int(rows[0]), int(columns[0])) if some else (0, 0)
        last = (int(rows[-1]), int(columns[-1])) if some else (-1, -1)
        self._blocked = np.zeros([b - a + 1 for a, b in zip(self._corner, last, strict=True)], bool)

    def free(
        self, rows: Int[np.ndarray, "r"], columns: Int[np.ndarray, "c"]
    ) -> Bool[np.ndarray, "r c"]:
        """Whether each pair of them may be taken."""
        a, b = self._corner
        return ~self._blocked[np.ix_(rows - a, columns - b)]

    def is_blocked(self, pair: Pair) -> bool:
        """Whether a pair of the rows and columns may not be taken."""
        return bool(self._blocked[pair[0] - self._corner[0], pair[1] - self._corner[1]])

    def block(self, pair: Pair) -> None:
        """Block the pairs around an existing one: those with |da| + |db| up to the reach."""
        limit = max(min(abs(pair[0] - pair[1]) - 2, self._reach), 0)
        for da in range(-limit, limit + 1):
            a = pair[0] + da - self._corner[0]
            if 0 <= a < len(self._blocked):
                rest = limit - abs(da)
                b = pair[1] - self._corner[1]
                self._blocked[a, max(b - rest, 0) : max(b + rest + 1, 0)] = True
