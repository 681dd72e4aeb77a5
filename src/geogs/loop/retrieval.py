"""Retrieval of keyframes similar to an image, by an inverted index over binary words."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from geogs.world.loops import ImageFeatures, Vocabulary

INDEXED = 300
"""Features of an image looked up and stored, strongest first; the rest only serve verification."""
WORD_RADIUS = 50
"""Bits (of 256) within which a descriptor belongs to an existing word."""
WORDS = 6144
"""Size at which the vocabulary stops growing; bounds the cost of a keyframe."""
LOOSE = 15
"""Increase of the words' radius, in bits, once the vocabulary is full."""


class Posting:
    """Keyframes that contain a word: their rows, and counts."""

    def __init__(self) -> None:
        self._room = np.zeros((4, 2), np.int64)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> Int64[np.ndarray, "m 2"]:
        """Row and count of each keyframe, earliest first."""
        return self._room[: self._count]

    def add(self, row: int, count: int) -> None:
        """Add a keyframe."""
        if self._count == len(self._room):
            self._room = np.concatenate([self._room, np.zeros_like(self._room)])
        self._room[self._count] = row, count
        self._count += 1


@dataclass(frozen=True)
class SimilarKeyframe:
    """An earlier keyframe of similar appearance."""

    keyframe: int
    score: float
    """Shared tf-idf mass over the query's own: 0 nothing in common, 1 the same image."""


class AppearanceIndex:
    """Index of keyframes by the words they contain.

    The vocabulary needs no training data: a descriptor farther than ``WORD_RADIUS`` bits from
    every word becomes a word itself (as in iBoW-LCD, Garcia-Fidalgo & Ortiz 2018, without its
    merging of words). Words common to many keyframes count little (inverse document frequency).
    """

    def __init__(self, vocabulary: Vocabulary | None = None, most_words: int = WORDS) -> None:
        """Continue with a ``vocabulary``, if given."""
        self._most_words = most_words
        self._vocabulary = v = vocabulary or Vocabulary()
        self._postings = [Posting() for _ in v.words]
        """Inverted index: keyframes of each word."""
        self._row = {keyframe: row for row, keyframe in enumerate(v.keyframes)}
        for row, counts in enumerate(v.counts):
            self._post(row, counts)
        self._recent: tuple[ImageFeatures, np.ndarray, np.ndarray] | None = None
        """Features looked up last, with their words: a keyframe is queried, then added."""

    def __len__(self) -> int:
        return len(self._vocabulary.keyframes)

    def add(self, keyframe: int, features: ImageFeatures) -> None:
        """Add a keyframe; its new descriptors become words."""
        descriptors = features.descriptors[:INDEXED]
        words, distance = self._nearest(features)
        v = self._vocabulary
        room = max(self._most_words - len(v.words), 0)
        fresh = np.flatnonzero(distance > self._radius)[:room]
        words = words.copy()
        words[fresh] = len(v.words) + np.arange(len(fresh))
        known = distance <= self._radius
        known[fresh] = True
        v.words = np.concatenate([v.words, descriptors[fresh]])
        self._recent = None
        self._postings.extend(Posting() for _ in fresh)
        row = self._row[keyframe] = len(v.keyframes)
        v.keyframes.append(keyframe)
        v.counts.append(_counts(words[known]))
        self._post(row, v.counts[-1])

    def query(
        self, features: ImageFeatures, exclude: Collection[int] = (), count: int = 5
    ) -> list[SimilarKeyframe]:
        """Return the ``count`` keyframes most similar to an image, without excluded, best first."""
        score = self._scores(features)
        score[[self._row[k] for k in exclude if k in self._row]] = 0.0
        best = np.argsort(-score, kind="stable")[:count]
        return [
            SimilarKeyframe(self._vocabulary.keyframes[r], float(score[r]))
            for r in best
            if score[r] > 0
        ]

    def _post(self, row: int, counts: Int64[np.ndarray, "c 2"]) -> None:
        for word, count in counts.tolist():
            self._postings[word].add(row, count)

    def _scores(self, features: ImageFeatures) -> Float64[np.ndarray, "rows"]:
        """Return the similarity of every row to an image."""
        rows = len(self)
        words, distance = self._nearest(features)
        known = distance <= self._radius
        # Descriptors without a word still count in the image's own mass.
        own = float((~known).sum()) * np.log((rows + 1) / 0.5)
        containing = [np.zeros(0, np.int64)]
        mass = [np.zeros(0)]
        for word, count in _counts(words[known]).tolist():
            posting = self._postings[word].rows
            weight = max(np.log((rows + 1) / (len(posting) + 0.5)), 0.0)
            own += weight * count
            containing.append(posting[:, 0])
            mass.append(weight * np.minimum(posting[:, 1], count))
        score = np.bincount(np.concatenate(containing), np.concatenate(mass), minlength=rows)
        return score / max(own, 1e-9)

    @property
    def _radius(self) -> int:
        full = len(self._vocabulary.words) >= self._most_words
        return WORD_RADIUS + LOOSE * full

    def _nearest(
        self, features: ImageFeatures
    ) -> tuple[Int64[np.ndarray, "n"], Int64[np.ndarray, "n"]]:
        """Return the nearest word of each descriptor and its distance in bits; 257 without any."""
        from geogs.loop.hamming_kernels import two_nearest

        if self._recent is not None and self._recent[0] is features:
            return self._recent[1:]
        indexed = features.descriptors[:INDEXED].view(np.uint64)
        words, distance, _ = two_nearest(indexed, self._vocabulary.words.view(np.uint64))
        self._recent = features, words, distance
        return words, distance


def _counts(words: Int64[np.ndarray, "n"]) -> Int64[np.ndarray, "c 2"]:
    """Return each word with its count, sorted by word."""
    return np.column_stack(np.unique(words, return_counts=True))
