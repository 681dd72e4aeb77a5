"""What of a reconstruction is left where matches between its pictures contradict their poses.

A wrong world need not lie off the epipolar lines: two parts that are joined with a wrong turn let
all matches between them lie near a circle through both cameras (a horopter), where any turn does.
But where a turn alone explains the matches in both coordinates, hardly another one can be true.
"""

from collections.abc import Container, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from geogs.evaluation.rotation_errors import rotation_angle
from geogs.geometry.nearest_rotation import nearest_rotation
from geogs_photos.verified_matches import MAX_ERROR, PairMatches, verified_matches

MOST = 0.5
"""Part of a pair's matches that has to be explained, by the poses or by a turn alone."""
TURN = 20.0
"""Degrees by which poses may turn otherwise than a turn that explains a pair by itself: beyond what
a step to the side does of which all that is seen is equally far."""
_ROUNDS = 15


def undisputed(model: Any, database: Path, known: Container[int] = ()) -> Any:
    """The largest part of a reconstruction across whose borders matches contradict its poses.

    The other pictures lose their poses: which of two parts is where it should be, nobody knows.
    With pictures ``known`` from elsewhere it is the part that holds these, which stay together.
    """
    images = sorted(image.image_id for image in model.images.values() if image.has_pose)
    first = next((k for k, number in enumerate(images) if number in known), None)
    place = {n: first if first is not None and n in known else k for k, n in enumerate(images)}
    votes = [
        (place[pair.one], place[pair.other], speaks_for(pair))
        for pair in verified_matches(model, database, images)
        if place[pair.one] != place[pair.other]
    ]
    parts = undivided(len(images), votes)
    kept = max(parts, key=lambda part: (first in part, len(part)), default=[])
    for number in images:
        if place[number] not in kept:
            model.deregister_frame(model.images[number].frame_id)
    return model


def speaks_for(pair: PairMatches) -> int:
    """Matches that speak for the poses of a pair; negative where as many speak against them."""
    by_poses = pair.epipolar() <= MAX_ERROR
    R, off = turn_alone(*pair.rays)
    by_turn = pair.focal * off <= MAX_ERROR
    if by_turn.mean() >= MOST and rotation_angle(R[None], pair.T[None, :3, :3])[0] > TURN:
        return -int(by_turn.sum())
    return int(by_poses.sum()) if by_poses.mean() >= MOST else -int((~by_poses).sum())


def turn_alone(
    one: Float64[np.ndarray, "n 3"], two: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "n"]]:
    """The rotation that takes rays nearest to others, and how far each ends (about radians).

    Least sum of distances, by weights (Kabsch's solution of each round).
    """
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (one, two))
    weight = np.ones(len(a))
    for _ in range(_ROUNDS):
        R = nearest_rotation((b * weight[:, None]).T @ a)
        off = np.linalg.norm(b - a @ R.T, axis=1)
        weight = 1 / off.clip(1e-3)
    return R, off


def undivided(count: int, votes: Sequence[tuple[int, int, int]]) -> list[list[int]]:
    """Parts of ``count`` pictures between which more speaks against their poses than for them.

    A pair of ``votes`` (one, other, matches for them, or negative against) that contradicts is
    parted by the minimum cut of what speaks for all (Ford and Fulkerson 1956), if across that cut
    more speaks against.
    """
    parts, open_parts = list[list[int]](), [list(range(count))]
    while open_parts:
        part = open_parts.pop()
        own = {k: place for place, k in enumerate(part)}
        inside = [(own[i], own[j], n) for i, j, n in votes if i in own and j in own]
        sides = _parted(len(part), inside)
        if sides is None:
            parts.append(part)
        else:
            open_parts += [[part[k] for k in np.flatnonzero(sides == s)] for s in (True, False)]
    return parts


def _parted(count: int, votes: Sequence[tuple[int, int, int]]) -> np.ndarray | None:
    """Which pictures are on one side of the first cut that is to be made; none where none is."""
    against = sorted((n, i, j) for i, j, n in votes if n < 0)
    joins = _graph(count, ((i, j, n) for i, j, n in votes if n > 0))
    for _, i, j in against:
        side = _reached(joins, i, j)
        across = sum(n for a, b, n in votes if side[a] != side[b])
        if across < 0:
            return side
    return None


def _reached(joins: csr_array, source: int, sink: int) -> np.ndarray:
    """The source's side of the minimum cut."""
    left = csr_array(joins - maximum_flow(joins, source, sink).flow)
    left.eliminate_zeros()
    side = np.zeros(joins.shape[0], bool)
    side[breadth_first_order(left, source, return_predecessors=False)] = True
    return side


def _graph(count: int, joins: Iterable[tuple[int, int, int]]) -> csr_array:
    rows = [(a, b, n) for i, j, n in joins for a, b in ((i, j), (j, i))]
    one, other, weight = np.array(rows, np.int32).reshape(-1, 3).T
    return csr_array(coo_array((weight, (one, other)), shape=(count, count)))
