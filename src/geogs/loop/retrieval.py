"""Which earlier keyframes look like an image: an inverted index over binary words."""

from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from geogs.errors import InputError
from geogs.loop.features import FeatureExtractor, Features

INDEXED = 300
"""Features of an image that are looked up and stored, strongest first; the rest serve to verify."""
WORD_RADIUS = 50
"""Bits (of 256) within which a descriptor belongs to an existing word."""
WORDS = 6144
"""Size at which the vocabulary stops growing; bounds the cost of a keyframe."""
LOOSE = 15
"""Bits by which the radius of the words grows once the vocabulary is full."""


class Posting:
    """The keyframes that hold a word: their rows, and how often they hold it."""

    def __init__(self) -> None:
        self._room = np.zeros((4, 2), np.int64)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> Int64[np.ndarray, "m 2"]:
        """Row and how often, earliest first."""
        return self._room[: self._count]

    def add(self, row: int, count: int) -> None:
        """Enter a keyframe."""
        if self._count == len(self._room):
            self._room = np.concatenate([self._room, np.zeros_like(self._room)])
        self._room[self._count] = row, count
        self._count += 1


@dataclass(frozen=True)
class Candidate:
    """An earlier keyframe that looks alike."""

    keyframe: int
    score: float
    """Shared tf-idf mass, of the query's own: 0 nothing in common, 1 the same image."""


@dataclass(frozen=True, eq=False)
class IndexState:
    """What a checkpoint holds of an index."""

    words: UInt8[np.ndarray, "w 32"]
    postings: Int64[np.ndarray, "m 3"]
    """Word, row and how often, word by word."""
    keyframes: Int64[np.ndarray, "r"]
    """Of each row."""


class AppearanceIndex:
    """Keyframes by the words they contain.

    The vocabulary needs no training data: a descriptor farther than ``WORD_RADIUS`` bits from
    every word becomes a word itself (as in iBoW-LCD, Garcia-Fidalgo & Ortiz 2018, without its
    merging of words). Words that many keyframes share count little (inverse document frequency).
    """

    def __init__(
        self, mask: Bool[np.ndarray, "h w"] | None = None, most_words: int = WORDS
    ) -> None:
        """Outside a ``mask`` of the size of the images nothing is looked at."""
        self._extract = FeatureExtractor(mask)
        self._most_words = most_words
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
        self._words = np.zeros((0, 32), np.uint8)
        self._postings: list[Posting] = []
        """Of each word."""
        self._keyframes: list[int] = []
        """Keyframe of each row."""
        self._row: dict[int, int] = {}
        """Row of each keyframe."""
        self._recent: tuple[Features, np.ndarray, np.ndarray] | None = None
        """Features last looked up with their words: a keyframe is queried, then added."""

    def __len__(self) -> int:
        return len(self._keyframes)

    def state(self) -> IndexState:
        """What a checkpoint holds."""
        rows = [posting.rows for posting in self._postings]
        words = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
        postings = np.column_stack([words, np.concatenate([*rows, np.zeros((0, 2), np.int64)])])
        return IndexState(self._words, postings, np.array(self._keyframes, np.int64))

    def load(self, state: IndexState) -> None:
        """Give an empty index the state of another. Raises InputError if it is incomplete."""
        counts = len(state.words), len(state.keyframes)
        if ((state.postings[:, :2] < 0) | (state.postings[:, :2] >= counts)).any():
            raise InputError("the index of looks is incomplete")
        self._words, self._keyframes = state.words, state.keyframes.tolist()
        self._row = {k: n for n, k in enumerate(self._keyframes)}
        self._postings = [Posting() for _ in state.words]
        for word, row, count in state.postings.tolist():
            self._postings[word].add(row, count)

    def describe(self, image: UInt8[np.ndarray, "h w 3"]) -> Features:
        """Features of an image, to be given to :meth:`add` and :meth:`query` in its stead."""
        return self._extract(image)

    def add(self, keyframe: int, image: UInt8[np.ndarray, "h w 3"] | Features) -> None:
        """Enter a keyframe; what is new in it becomes words."""
        features = self._features(image)
        descriptors = features.descriptors[:INDEXED]
        words, distance = self._nearest(features)
        room = max(self._most_words - len(self._words), 0)
        fresh = np.flatnonzero(distance > self._radius)[:room]
        words = words.copy()
        words[fresh] = len(self._words) + np.arange(len(fresh))
        known = distance <= self._radius
        known[fresh] = True
        self._words = np.concatenate([self._words, descriptors[fresh]])
        self._recent = None
        self._postings.extend(Posting() for _ in fresh)
        row = self._row[keyframe] = len(self._keyframes)
        self._keyframes.append(keyframe)
        for word, count in _counts(words[known]):
            self._postings[word].add(row, count)

    def query(
        self,
        image: UInt8[np.ndarray, "h w 3"] | Features,
        exclude: Collection[int] = (),
        count: int = 5,
    ) -> list[Candidate]:
        """The ``count`` most similar keyframes that are not excluded, best first."""
        score = self._scores(self._features(image))
        score[[self._row[k] for k in exclude if k in self._row]] = 0.0
        best = np.argsort(-score, kind="stable")[:count]
        return [Candidate(self._keyframes[r], float(score[r])) for r in best if score[r] > 0]

    def _scores(self, features: Features) -> Float64[np.ndarray, "rows"]:
        """Similarity of every row to an image."""
        rows = len(self._keyframes)
        words, distance = self._nearest(features)
        known = distance <= self._radius
        # A word that no keyframe has yet still belongs to what the image is.
        own = float((~known).sum()) * np.log((rows + 1) / 0.5)
        held, share = [np.zeros(0, np.int64)], [np.zeros(0)]
        for word, count in _counts(words[known]):
            posting = self._postings[word].rows
            weight = max(np.log((rows + 1) / (len(posting) + 0.5)), 0.0)
            own += weight * count
            held.append(posting[:, 0])
            share.append(weight * np.minimum(posting[:, 1], count))
        score = np.bincount(np.concatenate(held), np.concatenate(share), minlength=rows)
        return score / max(own, 1e-9)

    @property
    def _radius(self) -> int:
        full = len(self._words) >= self._most_words
        return WORD_RADIUS + LOOSE * full

    def _features(self, image: UInt8[np.ndarray, "h w 3"] | Features) -> Features:
        return image if isinstance(image, Features) else self.describe(image)

    def _nearest(self, features: Features) -> tuple[Int64[np.ndarray, "n"], Int64[np.ndarray, "n"]]:
        """Nearest word of each indexed descriptor and its distance in bits; 256 without a word."""
        if self._recent is not None and self._recent[0] is features:
            return self._recent[1:]
        descriptors = features.descriptors[:INDEXED]
        words = np.zeros(len(descriptors), np.int64)
        distance = np.full(len(descriptors), 256, np.int64)
        if len(descriptors) and len(self._words):
            for match in self._matcher.match(descriptors, self._words):
                words[match.queryIdx] = match.trainIdx
                distance[match.queryIdx] = int(match.distance)
        self._recent = features, words, distance
        return words, distance


def _counts(words: Int64[np.ndarray, "n"]) -> list[tuple[int, int]]:
    """Each word with how often it occurs, by word."""
    values, counts = np.unique(words, return_counts=True)
    return list(zip(values.tolist(), counts.tolist(), strict=True))
