"""The part of a reconstruction that is left where matches contradict the poses of its pictures.

A wrong world need not lie off the epipolar lines: two parts that are joined with a wrong turn let
all matches between them lie near a circle through both cameras (a horopter), where any turn does.
But where a turn alone explains the matches in both coordinates, hardly another one can be true.
And of a building whose sides look alike, more frames may match falsely than are joined in truth
(Heinly et al. 2014); but frames that follow one another show the same side.
"""

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from geogs.evaluation.rotation_errors import rotation_angle
from geogs.geometry.nearest_rotation import nearest_rotation
from geogs_photos.incremental_mapping import without_poses
from geogs_photos.photo_pairs import FOLLOWING
from geogs_photos.verified_matches import MAX_ERROR, PairMatches, verified_matches

LEAST_EXPLAINED = 0.5
"""Fraction of a pair's matches that has to be explained, by the poses or by a rotation alone."""
MAX_ROTATION_DISAGREEMENT_DEG = 20.0
"""Most between the rotation of two poses and one that explains their matches by itself: more than a
step to the side makes of a scene that is equally far everywhere."""
FOLLOWING_WEIGHT = 200
"""Times that matches of frames that follow one another count; those that speak for the poses twice
that, as few false ones are among many true ones anywhere (docs/notebook/photographs.md)."""
_FOLLOWING_WEIGHT_IN_CUTS = 1000
"""Times that they do where a cut is looked for: it goes through others, however many, where it can,
rather than around single frames that few hold."""
_ROUNDS = 15


@dataclass(frozen=True, slots=True)
class Vote:
    """Evidence of the matches of two pictures for or against their poses."""

    one: int
    other: int
    """Their places among the pictures."""
    matches: int
    """Number of matches that speak for the poses; negative where as many speak against them."""
    is_following: bool = False
    """Whether they follow one another in a video."""

    @property
    def weight(self) -> int:
        """How much it counts."""
        if not self.is_following:
            return self.matches
        return FOLLOWING_WEIGHT * (2 * self.matches if self.matches > 0 else self.matches)


def undisputed(model: Any, database: Path, known: Container[int] = ()) -> Any:
    """The largest part of a reconstruction across whose borders matches contradict its poses.

    The other pictures lose their poses: which of two parts is where it should be, nobody knows.
    With pictures ``known`` from elsewhere it is the part that holds these, which stay together.
    """
    images = _placed(model)
    first = next((k for k, number in enumerate(images) if number in known), None)
    place = {n: first if first is not None and n in known else k for k, n in enumerate(images)}
    parts = undivided(len(images), _votes(model, database, place))
    kept = max(parts, key=lambda part: (first in part, len(part)), default=[])
    return without_poses(model, [number for number in images if place[number] not in kept])


def false_pairs(model: Any, database: Path) -> list[tuple[int, int]]:
    """Pairs of pictures that speak for poses across the borders of the parts that others part."""
    images = _placed(model)
    votes = _votes(model, database, {number: k for k, number in enumerate(images)})
    part_of = {k: n for n, part in enumerate(undivided(len(images), votes)) for k in part}
    across = [v for v in votes if v.matches > 0 and part_of[v.one] != part_of[v.other]]
    return [(images[v.one], images[v.other]) for v in across]


def _placed(model: Any) -> list[int]:
    return sorted(image.image_id for image in model.images.values() if image.has_pose)


def _votes(model: Any, database: Path, place: dict[int, int]) -> list[Vote]:
    """Votes of all pairs of pictures with places of their own."""
    return [
        Vote(place[p.one], place[p.other], speaks_for(p), abs(p.other - p.one) <= FOLLOWING)
        for p in verified_matches(model, database, place)
        if place[p.one] != place[p.other]
    ]


def speaks_for(pair: PairMatches) -> int:
    """Matches that speak for the poses of a pair; negative where as many speak against them."""
    by_poses = (pair.epipolar() <= MAX_ERROR) & pair.in_front()
    R, off = best_rotation(*pair.rays)
    by_rotation = pair.focal * off <= MAX_ERROR
    if (
        by_rotation.mean() >= LEAST_EXPLAINED
        and rotation_angle(R[None], pair.T[None, :3, :3])[0] > MAX_ROTATION_DISAGREEMENT_DEG
    ):
        return -int(by_rotation.sum())
    return int(by_poses.sum()) if by_poses.mean() >= LEAST_EXPLAINED else -int((~by_poses).sum())


def best_rotation(
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


def undivided(count: int, votes: Sequence[Vote]) -> list[list[int]]:
    """Parts of ``count`` pictures between which more speaks against their poses than for them.

    A pair of ``votes`` that contradicts is parted by the minimum cut of what speaks for all (Ford
    and Fulkerson 1956), if across that cut more speaks against.
    """
    parts, open_parts = list[list[int]](), [list(range(count))]
    while open_parts:
        part = open_parts.pop()
        own = {k: place for place, k in enumerate(part)}
        inside = [
            Vote(own[v.one], own[v.other], v.matches, v.is_following)
            for v in votes
            if v.one in own and v.other in own
        ]
        sides = _parted(len(part), inside)
        if sides is None:
            parts.append(part)
        else:
            open_parts += [[part[k] for k in np.flatnonzero(sides == s)] for s in (True, False)]
    return parts


def _parted(count: int, votes: Sequence[Vote]) -> np.ndarray | None:
    """Which pictures are on one side of the first cut that is to be made; none where none is."""
    joins = _graph(count, (v for v in votes if v.matches > 0))
    for vote in sorted((v for v in votes if v.matches < 0), key=lambda v: v.weight):
        side = _reached(joins, vote.one, vote.other)
        if sum(v.weight for v in votes if side[v.one] != side[v.other]) < 0:
            return side
    return None


def _reached(joins: csr_array, source: int, sink: int) -> np.ndarray:
    """The source's side of the minimum cut."""
    left = csr_array(joins - maximum_flow(joins, source, sink).flow)
    left.eliminate_zeros()
    side = np.zeros(joins.shape[0], bool)
    side[breadth_first_order(left, source, return_predecessors=False)] = True
    return side


def _graph(count: int, joins: Iterable[Vote]) -> csr_array:
    rows = [
        (a, b, v.matches * (_FOLLOWING_WEIGHT_IN_CUTS if v.is_following else 1))
        for v in joins
        for a, b in ((v.one, v.other), (v.other, v.one))
    ]
    one, other, weight = np.array(rows, np.int32).reshape(-1, 3).T
    return csr_array(coo_array((weight, (one, other)), shape=(count, count)))
