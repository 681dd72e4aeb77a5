"""Loops: image features, the vocabulary, candidates, verified loops and relative poses."""

from collections.abc import Container
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8
from torch import Tensor

from geogs.config.setting import Range
from geogs.errors import InputError
from geogs.limits import SIMILARITY, KeyframeId, Number, Pose, Positive, Reference
from geogs.types import FlowMatch
from geogs.world.edges import Pair
from geogs.world.keyframes import KeyframeTable
from geogs.world.tables import check_tables

Cause = Literal["geometry", "appearance"]
"""Origin of a candidate pair: the present poses, or appearance alone."""


@dataclass(frozen=True)
class ImageFeatures:
    """Features of an image for place recognition; the strongest of every cell come first."""

    pixels: Float32[np.ndarray, "n 2"]
    """x, y."""
    descriptors: UInt8[np.ndarray, "n 32"]
    """256 bits each."""

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass
class Vocabulary:
    """Binary words and an index of the keyframes that contain them; mutable."""

    words: UInt8[np.ndarray, "v 32"] = field(default_factory=lambda: np.zeros((0, 32), np.uint8))
    keyframes: list[KeyframeId] = field(default_factory=list)
    """Keyframes indexed so far, earliest first."""
    counts: list[Int64[np.ndarray, "_ 2"]] = field(default_factory=list)
    """For each keyframe its words, ascending, and their counts."""


@dataclass(frozen=True)
class TwoViewMatch:
    """Outcome of matching the features of two views."""

    accepted: bool
    reason: str
    """Reason for rejection; empty if accepted."""
    T_ji: Pose | None = None
    """First camera to second, float64. In the first's lengths if metric, else with a translation
    of length one, which is arbitrary where the views have no parallax. None without a pose."""
    is_metric: bool = False
    scale: Positive | None = None
    """Lengths of the second's depth per length of the first's; None unless both have depth."""
    matches: Number = 0
    inliers: Number = 0
    spread: float = 0.0
    """Fraction of the raster's cells that hold inliers, in the poorer image."""

    @property
    def inlier_ratio(self) -> float:
        """Fraction of the matches that are inliers."""
        return self.inliers / max(self.matches, 1)


@dataclass(frozen=True)
class LoopCandidate:
    """A pair of keyframes that may show one place."""

    first: KeyframeId
    second: KeyframeId
    """The later."""
    cause: Cause


@dataclass(frozen=True)
class VerifiedCandidate:
    """A candidate and the feature match of its two views."""

    candidate: LoopCandidate
    view: TwoViewMatch


@dataclass(frozen=True)
class Loop:
    """A pair of keyframes that show one place, confirmed by dense flow."""

    first: KeyframeId
    second: KeyframeId
    """The later keyframe."""
    cause: Cause
    T_ji: Pose
    """First camera to second in the lengths of the first keyframe's depth, float64."""
    scale: Positive
    """Lengths of the second's depth per length of the first's: scale drift in between."""
    inliers: int
    """Features that agree with the pose; 0 where it comes from flow alone."""
    matched: float
    """Fraction of the cells whose flow agrees."""
    there: FlowMatch | None
    """Flow from the first to the second, one edge; None once it is no longer needed."""
    back: FlowMatch | None

    @property
    def S_ji(self) -> Float[Tensor, "4 4"]:
        """Sim(3) from the first camera to the second, each in its own unit of length."""
        S = self.scale * self.T_ji
        S[3, 3] = 1.0
        return S

    @property
    def flows(self) -> tuple[FlowMatch, FlowMatch]:
        """Flow there and back, while they are kept."""
        assert self.there is not None
        assert self.back is not None
        return self.there, self.back


@dataclass(frozen=True)
class RelativePoses:
    """Measured similarities between pairs of keyframes."""

    source: Annotated[Int64[Tensor, "e"], Reference("keyframes")]
    """Index of keyframe i."""
    target: Annotated[Int64[Tensor, "e"], Reference("keyframes")]
    """Index of keyframe j."""
    G: Annotated[Float64[Tensor, "e 4 4"], SIMILARITY]
    """Camera i, in the unit of keyframe i, to camera j in the unit of keyframe j; float64."""
    information: Annotated[Float64[Tensor, "e 7"], Range(0)]
    """Inverse variances of the error [tau, phi, sigma] in the frame of j: 1 / unit^2, 1 / rad^2
    and of the logarithm of scale; float64. Zero where nothing is known."""
    is_loop: Bool[Tensor, "e"]
    """Edges that may be outliers; the others are trusted."""

    def __len__(self) -> int:
        return len(self.source)

    @property
    def pairs(self) -> list[Pair]:
        """The two ends of each edge, the earlier first."""
        ends = zip(self.source.tolist(), self.target.tolist(), strict=True)
        return [(min(pair), max(pair)) for pair in ends]

    def select(self, keep: Bool[Tensor, "e"]) -> "RelativePoses":
        """Return the edges where ``keep`` is true."""
        parts = (self.source, self.target, self.G, self.information, self.is_loop)
        return RelativePoses(*(p[keep] for p in parts))

    def rescaled(self, scale: Float[Tensor, "n"]) -> "RelativePoses":
        """Return the same measurements after the unit of each keyframe was divided by ``scale``."""
        here, there = scale[self.source], scale[self.target]
        G = self.G.clone()
        G[:, :3, :3] *= (here / there)[:, None, None]
        G[:, :3, 3] /= there[:, None]
        information = self.information.clone()
        information[:, :3] *= there[:, None] ** 2
        return RelativePoses(self.source, self.target, G, information, self.is_loop)

    @staticmethod
    def none() -> "RelativePoses":
        """Return an empty set of relative poses."""
        empty = torch.zeros(0, dtype=torch.long)
        numbers = torch.zeros(0, 7, dtype=torch.float64)
        return RelativePoses(empty, empty, numbers.new_zeros(0, 4, 4), numbers, empty.bool())


@dataclass
class SegmentConstraints:
    """Relative poses between the keyframes of one segment, by id; mutable."""

    odometry: RelativePoses = field(default_factory=RelativePoses.none)
    """Relative poses from edges that the tracker no longer adjusts."""
    loops: RelativePoses = field(default_factory=RelativePoses.none)
    pending: int = 0
    """Number of loops that disagree with the poses, since the last attempt to close."""
    last_attempt: int = 0
    """Number of keyframes at the last attempt."""


@dataclass
class LoopTable:
    """State of loop closing; mutable."""

    keyframes: list[KeyframeId] = field(default_factory=list)
    """Keyframes searched for loops so far, earliest first."""
    features: dict[KeyframeId, ImageFeatures] = field(default_factory=dict)
    vocabulary: Vocabulary = field(default_factory=Vocabulary)
    found: list[list[VerifiedCandidate]] = field(default_factory=list)
    """Candidates of the latest keyframes that the flow has not verified yet."""
    loops: list[Loop] = field(default_factory=list)
    """Verified loops, earliest first."""
    between: list[Loop] = field(default_factory=list)
    """Loops between two segments."""
    constraints: dict[int, SegmentConstraints] = field(default_factory=dict)
    """Relative poses by the number of the segment."""
    closures: int = 0
    """Corrections by loops so far."""


def check_loops(table: LoopTable, keyframes: KeyframeTable, segments: Container[int]) -> None:
    """Check a table that was read; ``segments`` are the numbers of the existing segments.

    Raises InputError if it is incomplete, or names keyframes or segments that are missing.
    """
    check_tables(LoopTable, table, keyframes.grid.sizes, {"keyframes": keyframes})
    vocabulary = table.vocabulary
    words = len(table.vocabulary.words)
    counts = vocabulary.counts
    if len(counts) != len(vocabulary.keyframes) or any(
        ((c[:, 0] < 0) | (c[:, 0] >= words) | (c[:, 1] < 1)).any() for c in counts
    ):
        raise InputError("the index of appearance is incomplete")
    named = set(vocabulary.keyframes)
    for found in table.found:
        named.update(id for f in found for id in (f.candidate.first, f.candidate.second))
    for loop in table.loops:
        named.update((loop.first, loop.second))
    if not named <= {*table.keyframes} & table.features.keys():
        raise InputError("a keyframe that loops name was never searched for them")
    if not all(number in segments for number in table.constraints):
        raise InputError("the segment of a relative pose is missing")
