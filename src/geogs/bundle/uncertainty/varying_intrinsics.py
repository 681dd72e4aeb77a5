"""Estimation from matches of intrinsics that change from frame to frame.

Refocusing changes the magnification (focus breathing), as zooming does on purpose; stabilisation
moves the lens relative to the sensor, or the crop of the image. The focal length and the principal
point of each frame, relative to the shared ones, are unknowns, along with the shared lens; poses
and depths are eliminated.
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
from geogs.bundle.hyper_edge import DepthEquations, RelativeEdges
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
"""Shapes of a lens' error that are per-frame parameters: the logarithm of the focal length, and the
principal point along either side."""
EXPLAINED = 0.1
"""Least relative cost reduction for a parameter to be freed: 0.33 where the focal length varies by
1 %, below 0.06 where nothing varies (docs/notebook/lens.md)."""
LEAST = 2e-4
"""Smallest deviation of a per-frame parameter, also of one that does not vary."""
FIRST_DEVIATION = 0.02
"""Initial prior deviation of per-frame parameters."""
EXPECTATIONS = 10
"""EM iterations."""
COUNTS = 0.1
"""Weight of the matches' evidence, as errors of an edge's matches are correlated."""


class LensChange(Enum):
    """Parameters of a lens that may change from frame to frame, as indices into
    :attr:`VaryingPrior.deviations`."""

    FOCAL = 0, 3
    CENTRE = 1, 2


@dataclass(frozen=True)
class VaryingPrior:
    """Prior on per-frame intrinsics: white noise, plus a random walk of the focal length."""

    deviations: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    """Deviation of each parameter of a frame, and that of the logarithm of the last frame's focal
    length from the first one's; estimated from the video, zero where nothing varies."""

    def varies(self, change: LensChange) -> bool:
        """Whether a parameter varies."""
        return self.deviations[change.value[0]] > 0

    def also(self, change: LensChange) -> "VaryingPrior":
        """Return the prior with another varying parameter, with its initial deviation."""
        free = change.value
        each = enumerate(self.deviations)
        return VaryingPrior(tuple(FIRST_DEVIATION if n in free else size for n, size in each))

    def information(self, times: Float[Tensor, "n"]) -> Float[Tensor, "3 n n"]:
        """Return the inverse covariance of each parameter at some times; they are independent."""
        found = torch.zeros(len(OWN), len(times), len(times), dtype=torch.float64)
        for n, (part, square) in enumerate(zip(_parts(times), self._squares, strict=True)):
            found[n % len(OWN)] += square * part
        return torch.linalg.inv(found)

    @property
    def _squares(self) -> list[float]:
        return [max(LEAST, size) ** 2 for size in self.deviations]

    def between(
        self, known: Float64[np.ndarray, "n"], times: Float64[np.ndarray, "m"]
    ) -> Float[Tensor, "m 3"]:
        """Return deviations of frames at some times from values interpolated between those at
        ``known`` times: of a Brownian bridge plus white noise."""
        after = np.searchsorted(known, times).clip(1, len(known) - 1)
        before = known[after - 1]
        length = max(known[-1] - known[0], 1e-9)
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
        """Take one EM update of the variances, given parameters with their covariance. Parameters
        that do not vary stay fixed."""
        prior = self.information(times)
        found = []
        for n, (part, square) in enumerate(zip(_parts(times), self._squares, strict=True)):
            if self.deviations[n] == 0:
                found.append(0.0)
                continue
            k = n % len(OWN)
            second = sizes[:, k, None] * sizes[:, k] + covariance[:, k, :, k]
            both = prior[k] @ part
            less = ((both @ prior[k]) * second.mT).sum() - both.diagonal().sum()
            found.append(math.sqrt(max(LEAST**2, square + square**2 / len(times) * float(less))))
        return VaryingPrior(tuple(found))


def _parts(times: Float[Tensor, "n"]) -> list[Float[Tensor, "n n"]]:
    """Return unit covariances: of white noise for each parameter, and of a random walk."""
    alone = torch.eye(len(times), dtype=torch.float64)
    first = times.min()  # a saved map's frames may be of later times
    last = times.max()
    past = (times - first).double() / (last - first).clamp(min=1e-9)
    return [alone, alone, alone, torch.minimum(past[:, None], past)]


FIRST = VaryingPrior().also(LensChange.FOCAL).also(LensChange.CENTRE)


@dataclass(frozen=True)
class VaryingEvidence:
    """Normal equations of per-frame intrinsics, then of the shared ones."""

    information: Float[Tensor, "k k"]
    """Hessian, k = 3 n + 5; poses and depths are eliminated."""
    gradient: Float[Tensor, "k"]
    """Direction of descent."""
    cost: float
    """Cost of the matches' residuals (twice the objective)."""
    moves: Float[Tensor, "m k"]
    """Changes of all poses by an error of size one, left perturbations; m = 6 n."""

    def solved(
        self,
        times: Float[Tensor, "n"],
        taken: Float[Tensor, "k"],
        prior: VaryingPrior,
        shared: Float[Tensor, "5"],
    ) -> tuple[Float[Tensor, "k"], Float[Tensor, "k k"]]:
        """Solve for steps of all parameters, with their covariance. ``taken``: values for which
        matches are already corrected; ``shared``: prior deviations of the shared ones from zero."""
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
        """Return steps as in :meth:`solved`, and the prior estimated with them by EM, starting from
        ``prior``."""
        frames = len(times)
        own = len(self.gradient) - SHAPES
        for _ in range(EXPECTATIONS):
            step, covariance = self.solved(times, taken, prior, shared)
            open_ = covariance[:own, :own].reshape(frames, len(OWN), frames, len(OWN))
            prior = prior.suited(times, (taken + step)[:own].reshape(frames, -1), open_)
        return step, prior

    def explained(self, step: Float[Tensor, "k"]) -> float:
        """Return the relative cost reduction of a step beyond that of the shared lens alone."""
        less = 2 * self.gradient @ step - step @ self.information @ step
        H = self.information[-SHAPES:, -SHAPES:]
        g = self.gradient[-SHAPES:]
        damping = torch.diag(1e-9 * H.diagonal() + 1e-12)
        alone = g @ torch.linalg.solve(H + damping, g)
        return float(less - alone) / max(self.cost, 1e-12)


def varying_evidence(
    grid: SampleGrid, problem: AnyProblem, options: BundleOptions, cells: int = 256
) -> VaryingEvidence | None:
    """Compute the evidence of a problem's matches, at its solution, on the lens of each frame.

    None where they do not determine all poses. Parameters are errors for which matches are to be
    corrected (:func:`~geogs.bundle.uncertainty.lens_error.shifts_of_edges`).

    Args:
        grid: of the depths.
        problem: as for :func:`~geogs.bundle.uncertainty.marginals.marginals`; linearised once.
        options: Huber threshold and the damping of depths.
        cells: most cells of a frame that are used; they represent the others.
    """
    thinned = ThinnedProblem(grid, problem, cells)
    n = len(problem.T_cw)
    own = len(OWN)
    size = 6 * n
    sizes = own * n + SHAPES
    poses = torch.zeros(size, size, dtype=torch.float64)
    both = poses.new_zeros(size, sizes)
    information = poses.new_zeros(sizes, sizes)
    descent = poses.new_zeros(size)
    gradient = poses.new_zeros(sizes)
    flow = OwnLensFlow(thinned)
    cost = 0.0
    for part in thinned.parts(options):
        cost += flow.cost(part, part.start, options.huber)
        for source in linearised_sources(flow, part, part.start, options):
            edges = source.edges
            H, g = edges.chained()
            rows = edges.rows(n)[: len(g) - edges.shared]
            lens = _places(edges.poses, n)
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
    """Compute the effect of the remaining errors of per-frame intrinsics on poses and depths,
    without the shared focal length.

    Args:
        evidence: of the same problem.
        grid, problem, options: as for :func:`varying_evidence`.
        cells: most cells of a frame whose depths are used.
        own: estimated per-frame intrinsics, which determine the prior.
        times: of the frames.
        shared: prior deviations of the shared lens.
    """
    zero = torch.zeros_like(evidence.gradient)
    n = len(times)
    prior = FIRST
    for _ in range(EXPECTATIONS):
        prior = prior.suited(times, own, own.new_zeros(n, len(OWN), n, len(OWN)))
    _, left = evidence.solved(times, zero, prior, shared)
    thinned = ThinnedProblem(grid, problem, cells)
    relative = torch.zeros(n, thinned.count)
    for source in thinned.sources(options, OwnLensFlow(thinned)):
        coupling = source.edges.depth.coupling
        pull = coupling.new_zeros(thinned.count, len(zero))
        pull[:, _places(source.edges.poses, n)] = -coupling[-source.edges.shared :].mT
        alone = replace(source, edges=source.edges.of_poses())
        moved = thinned.depth_moves(alone, pull, evidence.moves)
        relative[source.frame] = ((moved @ left.to(moved)) * moved).sum(-1)
    return Considered(evidence.moves @ left @ evidence.moves.mT, relative)


def _places(poses: Int[Tensor, "e"], frames: int) -> Int[Tensor, "m"]:
    """Return indices of the parameters of a source's edges: of targets, itself, then shared."""
    own = len(OWN)
    each = (own * poses[:, None] + torch.arange(own)).reshape(-1)
    return torch.cat([each, own * frames + torch.arange(SHAPES)])


@dataclass(frozen=True)
class OwnLensFlow:
    """Dense flow of a pinhole's cells, with per-frame and shared errors of the lens."""

    thinned: ThinnedProblem

    def sources(
        self, problem: BundleProblem, state: BundleState, options: BundleOptions
    ) -> Iterator[SourceFlow]:
        """Yield sources as in the protocol; shared unknowns are the parameters of the targets, of
        the source, then of the shared lens."""
        camera = self.thinned.camera
        rays = self.thinned.rays
        own = list(OWN)
        T_ji = relative_motion(state.T_cw, problem.source, problem.target)
        p = linearise(camera, rays, T_ji, state.inverse_depth[problem.source])
        r, w = weighed_residuals(p, problem.pixels, problem.weight, options.huber)
        there, here = lens_shapes(camera, p.pixels), lens_shapes(camera, self.thinned.pixels)
        here = carried_over(camera, rays, T_ji, p, here[:, None].expand_as(there))
        # A shift added to a match is subtracted from the cell's projection.
        moved = torch.cat([-there[own], here[own], here - there]).permute(1, 0, 3, 2)
        J = torch.cat([p.pose_jacobian, moved], 1)
        wJ = J * w.mT[:, None]
        by_depth = p.depth_jacobian.mT[:, None]
        H = (wJ.flatten(2) @ J.flatten(2).mT).double()
        g = (wJ.flatten(2) @ r.mT.flatten(1)[..., None])[..., 0].double()
        E = (wJ * by_depth).sum(2)
        adjoint = se3_adjoint(T_ji)
        wd = w * p.depth_jacobian
        C = (wd * p.depth_jacobian).sum(-1)
        b = (wd * r).sum(-1)
        for frame, e in sources_within(problem.source):
            at = _edge_places(e.stop - e.start, len(OWN), J.shape[1])
            size = int(at.max()) + 1
            hessian = H.new_zeros(size, size)
            gradient = H.new_zeros(size)
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
        """Return the cost as in the protocol, with present weights."""
        T_ji = relative_motion(state.T_cw, problem.source, problem.target)
        depth = state.inverse_depth[problem.source]
        p = project(self.thinned.camera, self.thinned.rays, T_ji, depth)
        r, w = weighed_residuals(p, problem.pixels, problem.weight, huber)
        return float((w * r.square()).double().sum())


def _edge_places(edges: int, own: int, unknowns: int) -> Int[Tensor, "e k"]:
    """Return indices of each edge's unknowns among those of its source: its relative motion, its
    target's parameters, then those of all edges."""
    each = torch.arange(edges)[:, None]
    motion = 6 * each + torch.arange(6)
    target = 6 * edges + own * each + torch.arange(own)
    common = (6 + own) * edges + torch.arange(unknowns - 6 - own)
    return torch.cat([motion, target, common.expand(edges, -1)], 1)
