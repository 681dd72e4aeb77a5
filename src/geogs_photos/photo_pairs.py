"""Choice of the pairs of photographs to match: all of few, similar ones of many.

A pair is first previewed with the few hundred largest features of both (Wu 2013, preemptive
matching), at a hundredth of the cost of full matching. Beyond some hundred pictures even that is
only done for pictures with similar distributions of features over words (VLAD, Jegou et al. 2010),
and for neighbours by name.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from geogs.stopwatch import StageProgress
from geogs.threads import thread_map
from geogs_photos.photo_features import PhotoFeatures, squared_distances

ALL_PAIRS = 20
"""Most pictures of which every pair is matched in full."""
ALL_PREVIEWS = 200
"""Most pictures of which every pair is previewed."""
PREVIEW = 400
"""Features of a picture in a preview."""
LEAST_ALIKE = 6
"""Fewest matches in a preview for full matching."""
ALWAYS = 8
"""Number of most similar pictures that are matched in full if a preview has any matches."""
MAX_PARTNERS = 40
"""Most partners that a picture contributes, the most similar ones."""
NEIGHBOURS = 2
"""Number of next pictures by name that are always matched: photographs are often consecutive."""
FOLLOWING = 6
"""Number of next frames of a video with which each is always matched."""
_CANDIDATES = 60
"""Most similar pictures of each that are previewed."""
_RATIO = 0.85

Pairs = list[tuple[int, int]]
"""Indices of two pictures each, the first before the second, ascending."""


def choose_pairs(
    features: Sequence[PhotoFeatures],
    seed: int = 0,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Pairs:
    """Choose the pairs to match in full, by a method that depends on the number of pictures."""
    count = len(features)
    everything = [(i, j) for i in range(count) for j in range(i + 1, count)]
    if count <= ALL_PAIRS:
        return everything
    looked_at = everything if count <= ALL_PREVIEWS else _candidates(features, seed)
    previews = [f.largest(PREVIEW).astype(np.float32) for f in features]
    alike = thread_map(
        lambda pair: mutual_matches(previews[pair[0]], previews[pair[1]]), looked_at, progress
    )
    return _best(count, looked_at, alike)


def frame_pairs(features: Sequence[PhotoFeatures], seed: int, progress: StageProgress) -> Pairs:
    """Pairs of a video's frames, in time order: the chosen ones, and each with the next ones."""
    alike = choose_pairs(features, seed, lambda f: progress("choosing pairs", f))
    return sorted({*alike, *_following(len(features), FOLLOWING)})


def mutual_matches(one: Float32[np.ndarray, "n 128"], other: Float32[np.ndarray, "m 128"]) -> int:
    """Number of mutually nearest features that are clearly nearer than the second nearest."""
    if len(one) < 2 or len(other) < 2:
        return 0
    distance = squared_distances(one, other)
    forward = distance.argmin(1)
    backward = distance.argmin(0)
    two = np.partition(distance, 1, axis=1)[:, :2].clip(0)
    is_clear = two[:, 0] < _RATIO**2 * two[:, 1]
    return int((is_clear & (backward[forward] == np.arange(len(one)))).sum())


def _best(count: int, pairs: Pairs, alike: Sequence[int]) -> Pairs:
    """Pairs with enough matches in the preview, the most similar of each picture, neighbours."""
    of_picture: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for (i, j), matches in zip(pairs, alike, strict=True):
        if matches:
            of_picture[i].append((-matches, j))
            of_picture[j].append((-matches, i))
    kept = _following(count, NEIGHBOURS)
    for i, others in enumerate(of_picture):
        for rank, (matches, j) in enumerate(sorted(others)[:MAX_PARTNERS]):
            if rank < ALWAYS or -matches >= LEAST_ALIKE:
                kept.add((min(i, j), max(i, j)))
    return sorted(kept)


def _following(count: int, most: int) -> set[tuple[int, int]]:
    return {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + most, count))}


def _candidates(features: Sequence[PhotoFeatures], seed: int) -> Pairs:
    """Pairs of pictures with similar distributions of features."""
    appearance = vlad([f.largest(PREVIEW) for f in features], seed)
    likeness = appearance @ appearance.T
    np.fill_diagonal(likeness, -np.inf)
    nearest = np.argpartition(-likeness, _CANDIDATES, axis=1)[:, :_CANDIDATES]
    return sorted({(min(i, j), max(i, j)) for i, row in enumerate(nearest.tolist()) for j in row})


def vlad(
    descriptors: Sequence[UInt8[np.ndarray, "_n 128"]], seed: int = 0
) -> Float32[np.ndarray, "k d"]:
    """A unit vector for each picture: its descriptors' residuals to words common to all pictures.

    The words are the means of clusters of the pictures' own descriptors. A picture without
    descriptors gets zeros.
    """
    sample = np.concatenate([d[:200] for d in descriptors]).astype(np.float32)
    words = _clusters(sample, min(64, len(sample)), seed)
    vectors = np.zeros((len(descriptors), words.size), np.float32)
    for vector, some in zip(vectors, descriptors, strict=True):
        if not len(some):
            continue
        rows = some.astype(np.float32)
        word = ((words**2).sum(1) - 2 * rows @ words.T).argmin(1)
        residual = np.zeros_like(words)
        np.add.at(residual, word, rows - words[word])
        # Each word has the same weight, however many features it has (intra-normalisation).
        residual /= np.maximum(np.linalg.norm(residual, axis=1, keepdims=True), 1e-9)
        vector[:] = residual.ravel() / max(float(np.linalg.norm(residual)), 1e-9)
    return vectors


def _clusters(
    sample: Float32[np.ndarray, "n 128"], count: int, seed: int
) -> Float32[np.ndarray, "k 128"]:
    if count == 0:
        return np.zeros((1, 128), np.float32)
    cv2.setRNGSeed(seed)  # process-wide: OpenCV has no generator for one call
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 15, 1.0)
    _, _, centres = cv2.kmeans(
        sample, count, np.zeros((len(sample), 1), np.int32), criteria, 1, cv2.KMEANS_PP_CENTERS
    )
    return centres
