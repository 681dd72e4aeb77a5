"""Adjustment problems: frames, matches along the edges between them, and other terms."""

from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.terms import BundleState, DepthTerm, PoseTerm

Matches = Callable[[slice], tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]]
"""Returns measured positions and inverse variances for a slice of edges; called from threads."""


@dataclass(frozen=True)
class Problem:
    """Frames of one adjustment, and its terms other than matches."""

    T_cw: Float[Tensor, "n 4 4"]
    """World to camera, float64."""
    inverse_depth: Float[Tensor, "n p"]
    source: Int[Tensor, "e"]
    """Source of each matched edge; edges are sorted by it."""
    target: Int[Tensor, "e"]
    free_pose: Bool[Tensor, "n"]
    free_depth: Bool[Tensor, "n"]
    """Frames with free depth; only those of sources are adjusted."""
    depth_terms: tuple[DepthTerm, ...] = ()
    """Terms of the depths of frames that are sources of edges."""
    pose_terms: tuple[PoseTerm, ...] = ()

    @property
    def start(self) -> BundleState:
        """Initial state of the adjustment."""
        return BundleState(self.T_cw, self.inverse_depth)

    def joined(self) -> tuple[Int[Tensor, "e"], Int[Tensor, "e"]]:
        """Return sources and targets of all edges and pose terms, sorted by source."""
        if not self.pose_terms:
            return self.source, self.target
        source = torch.cat([self.source, *(term.source for term in self.pose_terms)])
        target = torch.cat([self.target, *(term.target for term in self.pose_terms)])
        order = source.argsort(stable=True)
        return source[order], target[order]

    def known_before(self) -> Float[Tensor, "n p"]:
        """Return the information of every inverse depth without its matches."""
        known = torch.zeros_like(self.inverse_depth)
        for term in self.depth_terms:
            if term.information is not None:
                known = known + term.information
        return known


@dataclass(frozen=True, kw_only=True)
class BundleProblem(Problem):
    """A problem whose matches are in memory.

    For a GPU, inverse depths, matches and depth terms have to be there; all else is best on the
    CPU.
    """

    pixels: Float[Tensor, "e p 2"]
    """Measured position in the target of every cell of the source."""
    weight: Float[Tensor, "e p 2"]
    """Inverse variance of x and y, 1 / pixel^2."""
    by_rows: Float[Tensor, "e p 2"] | None = None
    """Shift of the positions per second of readout (:class:`geogs.bundle.row_motions.RowMotions`);
    None for a global shutter."""

    def unrolled(self, readout: float) -> Float[Tensor, "e p 2"]:
        """Return the positions that a global shutter would have seen, if rows took so many seconds
        from the first to the last."""
        return self.pixels if self.by_rows is None else self.pixels - readout * self.by_rows

    def part(self, edges: slice) -> "BundleProblem":
        """Return the same frames with some of the edges."""
        by_rows = None if self.by_rows is None else self.by_rows[edges]
        return _part(self, edges, self.pixels[edges], self.weight[edges], by_rows)


@dataclass(frozen=True, kw_only=True)
class StreamedProblem(Problem):
    """A problem whose matches are fetched on demand; all else is on the CPU."""

    matches: Matches

    def part(self, edges: slice) -> BundleProblem:
        """Return the same frames with some of the edges."""
        return _part(self, edges, *self.matches(edges))


def _part(
    problem: Problem,
    edges: slice,
    pixels: Float[Tensor, "e p 2"],
    weight: Float[Tensor, "e p 2"],
    by_rows: Float[Tensor, "e p 2"] | None = None,
) -> BundleProblem:
    shared = {f.name: getattr(problem, f.name) for f in fields(Problem)}
    shared |= {"source": problem.source[edges], "target": problem.target[edges]}
    return BundleProblem(**shared, pixels=pixels, weight=weight, by_rows=by_rows)


@dataclass(frozen=True)
class MotionProblem:
    """Frames seen from fixed keyframes, independent of each other."""

    T_cw: Float[Tensor, "n 4 4"]
    """World to camera of the frames, float64."""
    inverse_depth: Float[Tensor, "e p"]
    """Inverse depths of the keyframe of each edge."""
    T_source: Float[Tensor, "e 4 4"]
    """World to the keyframe of each edge."""
    frame: Int[Tensor, "e"]
    """Frame of each edge."""
    pixels: Float[Tensor, "e p 2"]
    weight: Float[Tensor, "e p 2"]


def sources_within(source: Int[Tensor, "e"]) -> list[tuple[int, slice]]:
    """Return the sources of sorted edges with their slices of edges."""
    frames, counts = torch.unique_consecutive(source, return_counts=True)
    found = []
    start = 0
    for frame, count in zip(frames.tolist(), counts.tolist(), strict=True):
        found.append((frame, slice(start, start + count)))
        start += count
    return found


def source_chunks(source: Int[Tensor, "e"], size: int) -> list[slice]:
    """Return slices of about ``size`` edges that never split the edges of one source."""
    chunks = []
    start = 0
    last = 0
    for _, edges in sources_within(source):
        if edges.stop - start > size and last > start:
            chunks.append(slice(start, last))
            start = last
        last = edges.stop
    return [*chunks, slice(start, last)] if last else []
