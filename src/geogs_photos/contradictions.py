"""Removes the parts of a reconstruction whose poses the matches contradict.

The epipolar error alone does not reveal a wrong world: if two parts are joined with a wrong
rotation, all matches between them can lie near a circle through both cameras (a horopter), where
any rotation fits. But if a rotation alone explains the matches in both coordinates, hardly another
one can be true. If the sides of a building look alike, false matches can outnumber true ones
(Heinly et al. 2014); but consecutive frames show the same side.
"""

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize_scalar
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from geogs.evaluation.rotation_errors import rotation_angle
from geogs.geometry.nearest_rotation import nearest_rotation
from geogs.tracking.matching.two_view_rotation import gric
from geogs_photos.incremental_mapping import placed_images, without_poses
from geogs_photos.photo_pairs import FOLLOWING
from geogs_photos.verified_matches import MAX_ERROR, PairMatches, verified_matches

LEAST_EXPLAINED = 0.5
"""Least fraction of a pair's matches that the poses, or a rotation alone, have to explain."""
MAX_ROTATION_DISAGREEMENT_DEG = 20.0
"""Largest angle between the rotation of two poses and one that alone explains their matches: more
than a sideways step in front of a scene of constant depth causes."""
FOLLOWING_WEIGHT = 200
"""Weight of the matches of consecutive frames; twice that if they support the poses, as any set of
many true matches has a few false ones (docs/notebook/photographs.md)."""
_FOLLOWING_WEIGHT_IN_CUTS = 1000
"""The same weight in the search for a cut: the cut prefers to go through other pairs, however many,
rather than around single frames with few matches."""
_ROUNDS = 15
PAIRS = 60
"""Largest number of pairs of pictures that are tested for a pure rotation; evenly spread ones of
more."""
NEARLY_ALL = 0.9
"""Least fraction of them that a rotation has to explain as well as the poses do."""
DEVIATION = 0.5
"""Least standard deviation of matches, pixels."""
_FOCAL_RANGE = 0.3
"""Range of the search for the logarithm of the focal length's correction."""


@dataclass(frozen=True, slots=True)
class Vote:
    """Support of the matches of two pictures for their poses, or against them."""

    one: int
    other: int
    """Indices of both pictures."""
    matches: int
    """Number of matches that support the poses; negative if they contradict them."""
    is_following: bool = False
    """Whether the pictures are near each other in a video."""

    @property
    def weight(self) -> int:
        """Weight of the vote."""
        if not self.is_following:
            return self.matches
        return FOLLOWING_WEIGHT * (2 * self.matches if self.matches > 0 else self.matches)


def undisputed(model: Any, database: Path, known: Container[int] = ()) -> Any:
    """Reduce a reconstruction to its largest part without contradictions by matches.

    The other pictures lose their poses: matches do not tell which of two parts is right. With
    ``known`` pictures it is the part that contains these, which stay together.
    """
    images = _placed(model)
    first = next((k for k, number in enumerate(images) if number in known), None)
    place = {n: first if first is not None and n in known else k for k, n in enumerate(images)}
    parts = undivided(len(images), _votes(model, database, place))
    kept = max(parts, key=lambda part: (first in part, len(part)), default=[])
    return without_poses(model, [number for number in images if place[number] not in kept])


def false_pairs(model: Any, database: Path) -> list[tuple[int, int]]:
    """Pairs of pictures whose matches support the poses across the borders of separated parts."""
    images = _placed(model)
    votes = _votes(model, database, {number: k for k, number in enumerate(images)})
    part_of = {k: n for n, part in enumerate(undivided(len(images), votes)) for k in part}
    across = [v for v in votes if v.matches > 0 and part_of[v.one] != part_of[v.other]]
    return [(images[v.one], images[v.other]) for v in across]


def _placed(model: Any) -> list[int]:
    return sorted(image.image_id for image in model.images.values() if image.has_pose)


def _votes(model: Any, database: Path, place: dict[int, int]) -> list[Vote]:
    """Votes of all pairs of pictures with different indices."""
    return [
        Vote(place[p.one], place[p.other], speaks_for(p), abs(p.other - p.one) <= FOLLOWING)
        for p in verified_matches(model, database, place)
        if place[p.one] != place[p.other]
    ]


def speaks_for(pair: PairMatches) -> int:
    """Number of matches that support the poses of a pair; negative if they contradict them."""
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
    """The rotation that best aligns rays with others, and each residual (about radians).

    Least sum of distances, by reweighting (Kabsch's solution in each round).
    """
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (one, two))
    weight = np.ones(len(a))
    for _ in range(_ROUNDS):
        R = nearest_rotation((b * weight[:, None]).T @ a)
        off = np.linalg.norm(b - a @ R.T, axis=1)
        weight = 1 / off.clip(1e-3)
    return R, off


def undivided(count: int, votes: Sequence[Vote]) -> list[list[int]]:
    """Divide ``count`` pictures into parts between which more votes contradict than support poses.

    A contradicting pair of ``votes`` is separated by the minimum cut of the supporting votes (Ford
    and Fulkerson 1956), if more votes across that cut contradict than support the poses.
    """
    parts = list[list[int]]()
    open_parts = [list(range(count))]
    while open_parts:
        part = open_parts.pop()
        own = {k: place for place, k in enumerate(part)}
        inside = [
            replace(v, one=own[v.one], other=own[v.other])
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
    """Mask of the pictures on one side of the first necessary cut; none if no cut is."""
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


def only_rotates(model: Any, database: Path) -> bool:
    """Whether a rotation alone explains the matches of nearly all pairs of pictures.

    With a slightly wrong focal length, a rotation looks like parallax, and points at arbitrary
    distances explain it to a tenth of a pixel. A rotation with another focal length explains it as
    well, with fewer parameters; no focal length does so for a camera that moved, however little.

    All pairs have one focal length, with which rotations leave the smallest residuals. Torr's
    criterion (:func:`gric`) selects the model of each pair.
    """
    images = [image.image_id for image in placed_images(model)]
    pairs = list(verified_matches(model, database, images))
    pairs = pairs[:: -(-len(pairs) // PAIRS) or 1]
    if not pairs:
        return False
    deviation = max(DEVIATION, float(model.compute_mean_reprojection_error()))
    found = minimize_scalar(
        lambda longer: np.concatenate([_off(p, longer).clip(max=MAX_ERROR) for p in pairs]).mean(),
        bounds=(-_FOCAL_RANGE, _FOCAL_RANGE),
        method="bounded",
        options={"xatol": 0.01},
    )
    explained = [
        gric((_off(p, found.x) / deviation) ** 2, 2, 3)
        <= gric((p.epipolar() / deviation) ** 2, 3, 5)
        for p in pairs
    ]
    return float(np.mean(explained)) >= NEARLY_ALL


def _off(pair: PairMatches, longer: float) -> Float64[np.ndarray, "n"]:
    """Residuals of matches after the best rotation, pixels, if the logarithm of the focal length is
    larger by ``longer``."""
    times = float(np.exp(longer))
    one, two = (rays / [times, times, 1.0] for rays in pair.rays)
    return times * pair.focal * best_rotation(one, two)[1]
