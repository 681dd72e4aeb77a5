"""Choice of a view for each face: a good one, mostly that of its neighbours for large patches.

The energy is that of Lempitsky and Ivanov (2007), minimised by iterated conditional modes over the
candidates of each face.
"""

import numpy as np
from jaxtyping import Float32, Int, Int32, Int64

from geogs.mesh.texture.candidates import Candidates

SMOOTHNESS = 0.35
"""Cost of a neighbour with another view, relative to 1 - score / best score."""
MAX_COLOUR_DISTANCE = 40.0
"""Distance of a view's colour from the median of a face's views above which it is an outlier."""
_ROUNDS = 12


def face_neighbours(faces: Int[np.ndarray, "m 3"]) -> Int64[np.ndarray, "k 2"]:
    """Pairs of faces that share an edge; of an edge with more than two, successive ones."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((owner, edges[:, 1], edges[:, 0]))
    same = (edges[order[1:]] == edges[order[:-1]]).all(1)
    return np.stack([owner[order[:-1]][same], owner[order[1:]][same]], -1).astype(np.int64)


def without_colour_outliers(
    candidates: Candidates, gains: Float32[np.ndarray, "v 3"]
) -> Float32[np.ndarray, "m k"]:
    """Scores, zero for views that show another colour than most do: something hides the face.

    Faces with fewer than three views, or only outliers, keep theirs.
    """
    has_view = candidates.view >= 0
    colour = candidates.colour * gains[candidates.view.clip(0)]
    masked = np.where(has_view[..., None], colour, np.nan)
    enough = np.flatnonzero(has_view.sum(1) >= 3)
    median = np.zeros((len(colour), 3), np.float32)
    median[enough] = np.nanmedian(masked[enough], axis=1)
    distance = np.linalg.norm(colour - median[:, None], axis=-1)
    kept = candidates.score.copy()
    kept[enough] *= distance[enough] <= MAX_COLOUR_DISTANCE
    any_left = np.any(kept > 0, axis=1, keepdims=True)
    return np.where(any_left, kept, candidates.score).astype(np.float32)


def choose_views(
    candidates: Candidates,
    score: Float32[np.ndarray, "m k"],
    neighbours: Int64[np.ndarray, "e 2"],
) -> Int32[np.ndarray, "m"]:
    """The view of each face; -1 for faces that none shows."""
    best = score.max(1)
    cost = np.where(score > 0, 1 - score / np.maximum(best, 1e-12)[:, None], np.inf)
    label = np.where(best > 0, candidates.view[np.arange(len(score)), score.argmax(1)], -1)
    random = np.random.default_rng(0)
    one, other = neighbours.T
    rows = np.arange(len(score))
    for _ in range(_ROUNDS):
        agreeing = np.zeros(score.shape)
        for here, there in ((one, other), (other, one)):
            same = candidates.view[here] == label[there][:, None]
            np.add.at(agreeing, here, same)
        total = cost - SMOOTHNESS * agreeing
        choice = np.where(np.isfinite(cost).any(1), total.argmin(1), 0)
        wanted = np.where(best > 0, candidates.view[rows, choice], -1)
        # Neighbours that change at once might swap their views for ever.
        changes = (wanted != label) & (random.random(len(label)) < 0.6)
        if not (wanted != label).any():
            break
        label = np.where(changes, wanted, label)
    return label.astype(np.int32)
