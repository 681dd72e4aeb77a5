"""What matches say of intrinsics that change from frame to frame.

A lens that is focused anew magnifies otherwise (focus breathing), one that is stabilised moves
before its sensor or has its image cropped elsewhere, and a zoom does the first on purpose. The
focal length and the principal point of each frame, beside those of all, are unknowns that poses and
depths are eliminated from, along with the lens that all share.
Source: self-calibration with varying intrinsics (Pollefeys, Koch, Van Gool 1999), in the
adjustment.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from geogs.bundle.flow_term import (
    SourceFlow,
    damped_curvature,
    linearised_sources,
    weighed_residuals,
)
from geogs.bundle.hyper_edge import DepthEquations, HyperEdge, RelativeEdges
from geogs.bundle.problem import BundleProblem, sources_within
from geogs.bundle.projection import carried_over, linearise, project, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.terms import BundleState
from geogs.bundle.uncertainty.lens_error import RADIAL, SHAPES, lens_shapes
from geogs.bundle.uncertainty.marginals import Considered, pose_covariance
from geogs.bundle.uncertainty.thinned import AnyProblem, ThinnedProblem
from geogs.geometry.lie import se3_adjoint
from geogs.world.grid import SampleGrid

OWN = 0, RADIAL, RADIAL + 1
"""Of the shapes of a lens' error, those that each frame has of its own: the logarithm of the focal
length, and the principal point along either side."""
EXPLAINED = 0.1
"""Part of the matches' cost that has to go where something of a lens changes: 0.33 where the focal
length does by 1 %, below 0.06 where nothing does (docs/notebook/lens.md)."""
LEAST = 2e-4
"""Smallest deviation of a size, that of one which does not vary, too."""
FIRST_DEVIATION = 0.02
"""Of what frames have of their own before any match is asked."""
EXPECTATIONS = 10
"""Steps by which deviations are told."""
COUNTS = 0.1
"""Fraction of what matches say that counts, as those of an edge err together."""


class LensChange(Enum):
    """What of a lens may change from frame to frame."""

    FOCAL = "focal length"
    CENTRE = "principal point"


@dataclass(frozen=True)
class VaryingPrior:
    """What frames have of their own before any match is asked: independent of each other, and of
    the focal length a random walk beside. Deviations, which the video itself tells; zero of what
    does not change."""

    jitter: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the sizes of each frame."""
    drift: float = 0.0
    """Of the logarithm of the last frame's focal length from the first one's."""

    def varies(self, change: LensChange) -> bool:
        """Whether something changes."""
        return self.jitter[0 if change is LensChange.FOCAL else 1] > 0

    def also(self, change: LensChange) -> "VaryingPrior":
        """With something more that changes, by as much as may be expected of any lens."""
        focal, *centre = self.jitter
        if change is LensChange.FOCAL:
            return VaryingPrior((FIRST_DEVIATION, centre[0], centre[1]), FIRST_DEVIATION)
        return VaryingPrior((focal, FIRST_DEVIATION, FIRST_DEVIATION), self.drift)

    def information(self, times: Float[Tensor, "n"]) -> Float[Tensor, "3 n n"]:
        """Inverse covariance of each size of frames at some times; they are independent."""
        found = torch.zeros(len(OWN), len(times), len(times), dtype=torch.float64)
        for n, (part, square) in enumerate(zip(_parts(times), self._squares, strict=True)):
            found[n % len(OWN)] += square * part
        return torch.linalg.inv(found)

    @property
    def _squares(self) -> list[float]:
        return [max(LEAST, size) ** 2 for size in (*self.jitter, self.drift)]

    def between(
        self, known: Float64[np.ndarray, "n"], times: Float64[np.ndarray, "m"]
    ) -> Float[Tensor, "m 3"]:
        """Deviations of frames at some times from what those around them, whose sizes are
        ``known``, have interpolated: of a bridge, and of what each has beside."""
        after = np.searchsorted(known, times).clip(1, len(known) - 1)
        before, length = known[after - 1], max(known[-1] - known[0], 1e-9)
        span = np.maximum(known[after] - before, 1e-9)
        part = ((times - before) / span).clip(0, 1)
        squares = np.tile(self._squares[:3], (len(times), 1))
        squares[:, 0] += self._squares[3] * part * (1 - part) * span / length
        return torch.from_numpy(np.sqrt(squares))

    def suited(
        self,
        times: Float[Tensor, "n"],
        sizes: Float[Tensor, "n 3"],
        covariance: Float[Tensor, "n 3 n 3"],
    ) -> "VaryingPrior":
        """That which suits sizes that are known to a covariance better: a step of expectation
        maximisation of components of a variance. What does not change stays so."""
        prior, squares = self.information(times), self._squares
        found = []
        for n, (part, square) in enumerate(zip(_parts(times), squares, strict=True)):
            k = n % len(OWN)
            second = sizes[:, k, None] * sizes[:, k] + covariance[:, k, :, k]
            both = prior[k] @ part
            less = ((both @ prior[k]) * second.mT).sum() - both.diagonal().sum()
            found.append(math.sqrt(max(LEAST**2, square + square**2 / len(times) * float(less))))
        varying = [size > 0 for size in (*self.jitter, self.drift)]
        found = [size if varies else 0.0 for size, varies in zip(found, varying, strict=True)]
        return VaryingPrior((found[0], found[1], found[2]), found[3])


def _parts(times: Float[Tensor, "n"]) -> list[Float[Tensor, "n n"]]:
    """Covariances of size one: of what is independent for each size, and of a random walk."""
    alone = torch.eye(len(times), dtype=torch.float64)
    first, last = times.min(), times.max()  # a saved map's frames may be of later times
    past = (times - first).double() / (last - first).clamp(min=1e-9)
    return [alone, alone, alone, torch.minimum(past[:, None], past)]


FIRST = VaryingPrior().also(LensChange.FOCAL).also(LensChange.CENTRE)


@dataclass(frozen=True)
class VaryingEvidence:
    """Normal equations of what each frame's lens has of its own, then of what all share."""

    information: Float[Tensor, "k k"]
    """k = 3 n + 5; poses and depths are eliminated."""
    gradient: Float[Tensor, "k"]
    """The direction of descent."""
    cost: float
    """Of the matches' residuals, twice what is minimised."""
    moves: Float[Tensor, "m k"]
    """By how much an error of size one moves all poses, left perturbations; m = 6 n."""

    def solved(
        self,
        times: Float[Tensor, "n"],
        taken: Float[Tensor, "k"],
        prior: VaryingPrior,
        shared: Float[Tensor, "5"],
    ) -> tuple[Float[Tensor, "k"], Float[Tensor, "k k"]]:
        """Steps of all sizes and their covariance, where ``taken`` of them was taken off already;
        what all share is known to be zero to the deviations ``shared``."""
        own = len(self.gradient) - SHAPES
        known = torch.zeros_like(self.information)
        for k, each in enumerate(prior.information(times)):
            known[k : own : len(OWN), k : own : len(OWN)] = each
        known.diagonal()[own:] = shared.double().square().reciprocal()
        covariance = torch.linalg.inv(COUNTS * self.information + known)
        return covariance @ (COUNTS * self.gradient - known @ taken), covariance

    def told(
        self,
        times: Float[Tensor, "n"],
        taken: Float[Tensor, "k"],
        prior: VaryingPrior,
        shared: Float[Tensor, "5"],
    ) -> tuple[Float[Tensor, "k"], VaryingPrior]:
        """Steps as of :meth:`solved`, with what frames have of their own of the deviations that
        suit it best, found from ``prior`` on: second."""
        frames, own = len(times), len(self.gradient) - SHAPES
        for _ in range(EXPECTATIONS):
            step, covariance = self.solved(times, taken, prior, shared)
            open_ = covariance[:own, :own].reshape(frames, len(OWN), frames, len(OWN))
            prior = prior.suited(times, (taken + step)[:own].reshape(frames, -1), open_)
        return step, prior

    def explained(self, step: Float[Tensor, "k"]) -> float:
        """Part of the cost that a step takes off beyond what a lens that all share would."""
        less = 2 * self.gradient @ step - step @ self.information @ step
        H, g = self.information[-SHAPES:, -SHAPES:], self.gradient[-SHAPES:]
        damping = torch.diag(1e-9 * H.diagonal() + 1e-12)
        alone = g @ torch.linalg.solve(H + damping, g)
        return float(less - alone) / max(self.cost, 1e-12)


def varying_evidence(
    grid: SampleGrid, problem: AnyProblem, options: BundleOptions, cells: int = 256
) -> VaryingEvidence | None:
    """What the matches of a problem at its solution say of the lens of each frame.

    None where they do not tell of all poses. Sizes are those to be taken off the matches
    (:func:`~geogs.bundle.uncertainty.lens_error.shape_shifts`).

    Args:
        grid: where the depths are.
        problem: as of :func:`~geogs.bundle.uncertainty.marginals.marginals`; it is linearised once.
        options: Huber's limit and the damping of depths.
        cells: most cells of a frame that are asked; the others are taken to say the same.
    """
    thinned = ThinnedProblem(grid, problem, cells)
    n, own = len(problem.T_cw), len(OWN)
    size, sizes = 6 * n, own * n + SHAPES
    poses = torch.zeros(size, size, dtype=torch.float64)
    both, information = poses.new_zeros(size, sizes), poses.new_zeros(sizes, sizes)
    descent, gradient = poses.new_zeros(size), poses.new_zeros(sizes)
    flow, cost = OwnLensFlow(thinned), 0.0
    for part in thinned.parts(options):
        state = BundleState(part.T_cw, part.inverse_depth)
        cost += flow.cost(part, state, options.huber)
        for source in linearised_sources(flow, part, state, options):
            edges = source.edges
            H, g = edges.chained()
            rows, lens = edges.rows(n)[: len(g) - edges.shared], _places(edges.poses, n)
            c = len(rows)
            poses[rows[:, None], rows] += H[:c, :c]
            both[rows[:, None], lens] += H[:c, c:]
            information[lens[:, None], lens] += H[c:, c:]
            descent[rows] += g[:c]
            gradient[lens] += g[c:]
    scale = 1 / thinned.fraction
    covariance = pose_covariance(problem, poses)
    if not bool(covariance.isfinite().all()):
        return None
    follow = covariance @ both
    information = information - both.mT @ follow
    gradient = gradient - follow.mT @ descent
    return VaryingEvidence(scale * information, scale * gradient, scale * cost, -follow)


def considered_lenses(
    evidence: VaryingEvidence,
    grid: SampleGrid,
    problem: AnyProblem,
    options: BundleOptions,
    cells: int,
    own: Float[Tensor, "n 3"],
    times: Float[Tensor, "n"],
    shared: Float[Tensor, "5"],
) -> Considered:
    """What is left open of the lens of each frame, once it was found, and what that does to poses
    and depths; of the focal length of all nothing is said.

    Args:
        evidence: of the same problem.
        grid, problem, options: as of :func:`varying_evidence`.
        cells: of a frame at most, whose depths are looked at.
        own: what was found, which tells by how much lenses vary.
        times: of the frames.
        shared: deviations of the lens of all.
    """
    zero, n = torch.zeros_like(evidence.gradient), len(times)
    prior = FIRST
    for _ in range(EXPECTATIONS):
        prior = prior.suited(times, own, own.new_zeros(n, len(OWN), n, len(OWN)))
    _, left = evidence.solved(times, zero, prior, shared)
    thinned = ThinnedProblem(grid, problem, cells)
    relative = torch.zeros(n, thinned.count)
    flow = OwnLensFlow(thinned)
    for part in thinned.parts(options):
        state = BundleState(part.T_cw, part.inverse_depth)
        for source in linearised_sources(flow, part, state, options):
            edges = source.edges
            assert edges.depth is not None
            lens = _places(edges.poses, n)
            pull = edges.depth.coupling.new_zeros(thinned.count, len(zero))
            pull[:, lens] = -edges.depth.coupling[-edges.shared :].mT
            alone = replace(source, edges=_of_poses(edges))
            moved = thinned.depth_moves(alone, pull, evidence.moves)
            relative[source.frame] = ((moved @ left.to(moved)) * moved).sum(-1)
    return Considered(evidence.moves @ left @ evidence.moves.mT, relative)


def _of_poses(edges: HyperEdge) -> HyperEdge:
    """Without what else they share."""
    assert edges.depth is not None
    size = len(edges.gradient) - edges.shared
    depth = replace(edges.depth, coupling=edges.depth.coupling[:size])
    H, g = edges.hessian[:size, :size], edges.gradient[:size]
    return replace(edges, hessian=H, gradient=g, shared=0, depth=depth)


def _places(poses: Int[Tensor, "e"], frames: int) -> Int[Tensor, "m"]:
    """Of the sizes that a source's edges join: its targets', its own, and those of all."""
    own = len(OWN)
    each = (own * poses[:, None] + torch.arange(own)).reshape(-1)
    return torch.cat([each, own * frames + torch.arange(SHAPES)])


class OwnLensFlow:
    """Dense flow of a pinhole's cells, with a lens' error of each frame and one of all."""

    def __init__(self, thinned: ThinnedProblem) -> None:
        self._camera, self._rays, self._pixels = thinned.camera, thinned.rays, thinned.pixels

    def sources(
        self, problem: BundleProblem, state: BundleState, options: BundleOptions
    ) -> Iterator[SourceFlow]:
        """As in the protocol of terms; shared unknowns are the sizes of the targets' lenses, of the
        source's, and of that of all."""
        camera, own = self._camera, list(OWN)
        T_ji = relative_motion(state.T_cw, problem.source, problem.target)
        p = linearise(camera, self._rays, T_ji, state.inverse_depth[problem.source])
        r, w = weighed_residuals(p, problem.pixels, problem.weight, options.huber)
        there, here = lens_shapes(camera, p.pixels), lens_shapes(camera, self._pixels)
        here = carried_over(camera, self._rays, T_ji, p, here[:, None].expand_as(there))
        # What is to be added to a match is what the lens takes off where its cell falls.
        moved = torch.cat([-there[own], here[own], here - there]).permute(1, 0, 3, 2)
        J = torch.cat([p.pose_jacobian, moved], 1)
        wJ, by_depth = J * w.mT[:, None], p.depth_jacobian.mT[:, None]
        H = (wJ.flatten(2) @ J.flatten(2).mT).double()
        g = (wJ.flatten(2) @ r.mT.flatten(1)[..., None])[..., 0].double()
        E, adjoint = (wJ * by_depth).sum(2), se3_adjoint(T_ji)
        wd = w * p.depth_jacobian
        C, b = (wd * p.depth_jacobian).sum(-1), (wd * r).sum(-1)
        for frame, e in sources_within(problem.source):
            at = _edge_places(e.stop - e.start, len(OWN), J.shape[1])
            size = int(at.max()) + 1
            hessian, gradient = H.new_zeros(size, size), H.new_zeros(size)
            coupling = E.new_zeros(size, E.shape[2])
            for n, edge in zip(at, range(e.start, e.stop), strict=True):
                hessian[n[:, None], n] += H[edge]
                gradient[n] += g[edge]
                coupling[n] += E[edge]
            curvature = C[e].sum(0)
            equations = DepthEquations(
                coupling, damped_curvature(curvature, options.depth_damping), b[e].sum(0), curvature
            )
            joins = torch.cat([problem.target[e], problem.source[e][:1]])
            shared = size - 6 * len(at)
            yield SourceFlow(
                frame,
                RelativeEdges(joins, hessian, gradient, shared, equations, adjoint=adjoint[e]),
            )

    def cost(self, problem: BundleProblem, state: BundleState, huber: float) -> float:
        """As in the protocol, of what is weighed now."""
        T_ji = relative_motion(state.T_cw, problem.source, problem.target)
        p = project(self._camera, self._rays, T_ji, state.inverse_depth[problem.source])
        r, w = weighed_residuals(p, problem.pixels, problem.weight, huber)
        return float((w * r.square()).double().sum())


def _edge_places(edges: int, own: int, unknowns: int) -> Int[Tensor, "e k"]:
    """Where the unknowns of each edge stand among those of its source: its relative motion, its
    target's sizes, then those that all edges have."""
    each = torch.arange(edges)[:, None]
    motion = 6 * each + torch.arange(6)
    target = 6 * edges + own * each + torch.arange(own)
    common = (6 + own) * edges + torch.arange(unknowns - 6 - own)
    return torch.cat([motion, target, common.expand(edges, -1)], 1)
