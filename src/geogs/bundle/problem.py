"""What is adjusted: frames, the edges between them, and what was matched along the edges."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.measured_motions import MeasuredMotions

Matches = Callable[[slice], tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]]
"""Measured positions and their inverse variances for a slice of edges; asked from threads."""


MEASURED_HUBER = 3.0
"""Deviations of a measured depth beyond which it counts linearly. Matches have a smaller knee: they
are wrong altogether more often than what a sensor says away from edges."""


@dataclass(frozen=True)
class MeasuredDepths:
    """Inverse depths that were measured beside the matches, each on its own; robust by Huber."""

    inverse_depth: Float[Tensor, "n p"]
    information: Float[Tensor, "n p"]
    """Inverse variances; 0 where nothing was measured."""

    def of(self, frame: int) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"]]:
        """Measurements of a frame and their information."""
        return self.inverse_depth[frame], self.information[frame]

    def pull(
        self, frame: int, inverse_depth: Float[Tensor, "p"]
    ) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"]]:
        """Curvature and gradient a, a (measured - d) of a frame at inverse depths d.

        a is the information times Huber's factor, see ``MEASURED_HUBER``.
        """
        measured, information = self.of(frame)
        residual = measured - inverse_depth
        norm = information.sqrt() * residual.abs()
        curvature = information * (MEASURED_HUBER / norm.clamp(min=MEASURED_HUBER))
        return curvature, curvature * residual


@dataclass(frozen=True)
class BundleProblem:
    """Frames and edges of one adjustment; edges are sorted by source.

    On a GPU only inverse depths, pixels and weights need to be there; all else is best on the CPU.
    """

    T_cw: Float[Tensor, "n 4 4"]
    """float64."""
    inverse_depth: Float[Tensor, "n p"]
    source: Int[Tensor, "e"]
    target: Int[Tensor, "e"]
    pixels: Float[Tensor, "e p 2"]
    """Measured position in the target of every cell of the source."""
    weight: Float[Tensor, "e p 2"]
    """Inverse variance of x and y, 1 / pixel^2."""
    free_pose: Bool[Tensor, "n"]
    free_depth: Bool[Tensor, "n"]
    damping: Float[Tensor, "n p"] | None = None
    """Added to the curvature sum_e w |dp/dd|^2 of each inverse depth (DROID-SLAM's eta)."""
    measured: MeasuredDepths | None = None
    motions: MeasuredMotions | None = None

    def damping_of(self, frame: int) -> Float[Tensor, "p"] | float:
        """``damping`` of a frame; zero where there is none."""
        return 0.0 if self.damping is None else self.damping[frame]


@dataclass(frozen=True)
class StreamedProblem:
    """As ``BundleProblem``, on the CPU, with the matches fetched when they are needed."""

    T_cw: Float[Tensor, "n 4 4"]
    inverse_depth: Float[Tensor, "n p"]
    source: Int[Tensor, "e"]
    target: Int[Tensor, "e"]
    matches: Matches
    free_pose: Bool[Tensor, "n"]
    free_depth: Bool[Tensor, "n"]
    damping: Float[Tensor, "n p"] | None = None
    measured: MeasuredDepths | None = None
    motions: MeasuredMotions | None = None

    def part(self, edges: slice) -> BundleProblem:
        """The same frames with some of the edges."""
        pixels, weight = self.matches(edges)
        return BundleProblem(
            self.T_cw, self.inverse_depth, self.source[edges], self.target[edges], pixels, weight,
            self.free_pose, self.free_depth, self.damping, self.measured, self.motions,
        )  # fmt: skip

    def joined(self) -> tuple[Int[Tensor, "e"], Int[Tensor, "e"]]:
        """Sources and targets of all that joins poses, sorted by source."""
        if self.motions is None:
            return self.source, self.target
        source = torch.cat([self.source, self.motions.source])
        target = torch.cat([self.target, self.motions.target])
        order = source.argsort(stable=True)
        return source[order], target[order]


@dataclass(frozen=True)
class MotionProblem:
    """Frames seen from keyframes that stay as they are; nothing joins two frames."""

    T_cw: Float[Tensor, "n 4 4"]
    """float64."""
    inverse_depth: Float[Tensor, "e p"]
    """Of the keyframe of each edge."""
    T_source: Float[Tensor, "e 4 4"]
    """World to the keyframe of each edge."""
    frame: Int[Tensor, "e"]
    """Which of the frames an edge sees."""
    pixels: Float[Tensor, "e p 2"]
    weight: Float[Tensor, "e p 2"]


def known_before(problem: BundleProblem | StreamedProblem) -> Float[Tensor, "n p"]:
    """Information of every inverse depth without its matches: of what was measured beside them."""
    if problem.measured is None:
        return torch.zeros_like(problem.inverse_depth)
    return problem.measured.information.clone()


def sources_within(source: Int[Tensor, "e"]) -> list[tuple[int, slice]]:
    """The sources of sorted edges and which edges are theirs."""
    frames, counts = torch.unique_consecutive(source, return_counts=True)
    found, start = [], 0
    for frame, count in zip(frames.tolist(), counts.tolist(), strict=True):
        found.append((frame, slice(start, start + count)))
        start += count
    return found


def source_chunks(source: Int[Tensor, "e"], size: int) -> list[slice]:
    """Slices of about ``size`` edges that never split the edges of one source."""
    chunks, start, last = [], 0, 0
    for _, edges in sources_within(source):
        if edges.stop - start > size and last > start:
            chunks.append(slice(start, last))
            start = last
        last = edges.stop
    return [*chunks, slice(start, last)] if last else []
