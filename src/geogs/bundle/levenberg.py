"""Bundle adjustment whose variables are also some that all edges share, such as a lens.

Levenberg-Marquardt on the tracker's cost (:mod:`geogs.bundle.dense`) with a block of unknowns
beside poses and inverse depths: depths are eliminated frame by frame, then poses and block are
solved together in float64. The first pose is fixed; the scale, which nothing measures, is held by a
penalty along it, so that nothing else resists the block.

Stars, their elimination and their chain to the poses are the tracker's
(:mod:`geogs.bundle.linearise`). What is summed over the cells of an edge is summed here in another
order than there, where the tracker's speed counts: the last bits of either's results depend on it.
"""

from dataclasses import dataclass, replace
from typing import Generic

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.blocks import B, SharedBlock
from geogs.bundle.linearise import (
    EliminatedDepth,
    Star,
    damped_curvature,
    edge_residual,
    weighed_residuals,
)
from geogs.bundle.problem import BundleProblem, sources_within
from geogs.bundle.projection import relative_motion
from geogs.geometry.lie import move, se3_adjoint, se3_inverse


@dataclass(frozen=True)
class LevenbergOptions:
    """How a problem is solved."""

    iterations: int = 15
    """Linearisations, at most."""
    huber: float = 3.0
    """Standard deviations beyond which a residual counts linearly."""
    damping: float = 1e-3
    """Levenberg damping at the start, relative to the diagonal."""
    least_decrease: float = 1e-4
    """Share of the cost; less ends the iteration."""
    depth_damping: float = 1e-5
    """Added to the curvature of each inverse depth, relative to the mean of its frame."""
    min_inverse_depth: float = 1e-3
    max_inverse_depth: float = 1e2


@dataclass(frozen=True)
class LevenbergResult(Generic[B]):
    """The adjusted problem, and how well the block is known."""

    block: B
    T_cw: Float[Tensor, "n 4 4"]
    inverse_depth: Float[Tensor, "n p"]
    information: Float[Tensor, "n p"]
    """Sum over a frame's edges of w |dp/dd|^2 before the last step."""
    cost: float
    """Mean over the matched cells of Huber's cost of a residual, in variances of a match."""
    covariance: Float[Tensor, "m m"]
    """Of the block's unknowns (zero for those that are no variables), see :func:`solve_shared`."""
    finite: bool


def solve_shared(
    problem: BundleProblem, block: B, options: LevenbergOptions | None = None
) -> LevenbergResult[B]:
    """Adjust all free poses, all inverse depths and the block; every frame's depth is free.

    The covariance is cluster-robust (Liang and Zeger's sandwich):
    ``S^-1 (sum_i g_i g_i^T) S^-1`` with the reduced gradient ``g_i`` of each source frame, since
    the errors of neighbouring cells, and of one cell in several targets, are alike; no noise level
    and no count of independent cells is needed. A step that is not finite ends the adjustment.
    """
    options = options or LevenbergOptions()
    T, d = problem.T_cw, problem.inverse_depth
    damping, finite = options.damping, True
    cost = robust_cost(problem, block, T, d, options.huber)
    system = LinearSystem.of(problem, block, T, d, options.huber, options.depth_damping)
    for _ in range(options.iterations):
        step = system.step(damping)
        if step is None:
            finite = False
            break
        xi, shared = step[: 6 * len(T)].reshape(-1, 6), step[6 * len(T) :]
        moved_block = block.moved(shared)
        moved_T = torch.where(problem.free_pose[:, None, None], move(xi, T), T)
        moved_d = system.moved_depth(step, d)
        moved_d = moved_d.clamp(options.min_inverse_depth, options.max_inverse_depth)
        moved_cost = robust_cost(problem, moved_block, moved_T, moved_d, options.huber)
        if not moved_cost < cost:
            damping = max(damping, 1e-6) * 10
            if damping > 1e3:
                break
            continue
        done = cost - moved_cost < options.least_decrease * cost
        block, T, d, cost = moved_block, moved_T, moved_d, moved_cost
        system = LinearSystem.of(problem, block, T, d, options.huber, options.depth_damping)
        damping = damping / 10
        if done:
            break
    information = torch.zeros_like(d)
    for star in system.stars:
        information[star.frame] = star.information
    covariance = system.covariance()
    finite = finite and bool(torch.isfinite(covariance).all())
    return LevenbergResult(block, T, d, information, cost, covariance, finite)


def robust_cost(
    problem: BundleProblem,
    block: SharedBlock,
    T_cw: Float[Tensor, "n 4 4"],
    inverse_depth: Float[Tensor, "n p"],
    huber: float,
) -> float:
    """Mean of Huber's cost over the matched cells; one behind its target counts as 10 hubers off.

    Infinite where nothing is matched.
    """
    source = problem.source
    at = block.project(T_cw, source, problem.target, inverse_depth[source])
    norm = (problem.weight * (problem.pixels - at.pixels).square()).sum(-1).sqrt()
    norm = torch.where(at.valid, norm, torch.full_like(norm, 10 * huber))
    cost = torch.where(norm < huber, norm.square(), 2 * huber * norm - huber**2)
    matched = problem.weight[..., 0] > 0
    return (
        float((cost * matched).sum(dtype=torch.float64) / matched.sum())
        if bool(matched.any())
        else float("inf")
    )


@dataclass(frozen=True)
class LinearSystem:
    """The problem linearised at one state, over all poses, then the block."""

    stars: list[Star]
    hessian: Float[Tensor, "v v"]
    """Depths eliminated, the scale held; float64."""
    gradient: Float[Tensor, "v"]
    poses: int
    """Number of poses."""
    free: Int[Tensor, "f"]
    """Which of its rows may move."""
    largest_step: float
    """Of the block's unknowns."""

    @staticmethod
    def of(
        problem: BundleProblem,
        block: SharedBlock,
        T: Float[Tensor, "n 4 4"],
        d: Float[Tensor, "n p"],
        huber: float,
        depth_damping: float,
    ) -> "LinearSystem":
        """Sum the stars of all sources up."""
        n, shared = len(T), len(block.free)
        size = 6 * n + shared
        H = torch.zeros(size, size, dtype=torch.float64)
        diagonal, g = H.new_zeros(size), H.new_zeros(size)
        stars = []
        for _, e in sources_within(problem.source):
            star, curvature = _star(problem, block, T, d, e, huber, depth_damping)
            rows = _rows(star, n)
            hessian, gradient = star.chained()
            H[rows[:, None], rows] += hessian
            diagonal[rows] += curvature
            g[rows] += gradient
            stars.append(star)
        centre = se3_inverse(T[0])[:3, 3]
        away = (T[:, :3, :3] @ centre + T[:, :3, 3]).double().cpu()
        scale = torch.cat([torch.cat([away, 0 * away], 1).reshape(-1), H.new_zeros(shared)])
        scale = scale / scale.norm().clamp(min=1e-12)
        H = H + diagonal.mean() * scale[:, None] * scale
        free = [*problem.free_pose.repeat_interleave(6).tolist(), *block.free]
        rows = torch.nonzero(torch.tensor(free))[:, 0]
        return LinearSystem(stars, H, g, n, rows, block.largest_step)

    def step(self, damping: float) -> Float[Tensor, "v"] | None:
        """The damped step of all unknowns; None where it cannot be had."""
        H, g, free = self.hessian, self.gradient, self.free
        system = H[free[:, None], free] + torch.diag(damping * H.diagonal()[free].abs() + 1e-6)
        factor, info = torch.linalg.cholesky_ex(system)
        step = torch.zeros_like(g)
        if int(info):
            return None
        step[free] = torch.cholesky_solve(g[free, None], factor)[:, 0]
        step[6 * self.poses :].clamp_(-self.largest_step, self.largest_step)
        return step if bool(torch.isfinite(step).all()) else None

    def moved_depth(
        self, step: Float[Tensor, "v"], d: Float[Tensor, "n p"]
    ) -> Float[Tensor, "n p"]:
        """Inverse depths after a step of everything."""
        out = d.clone()
        for star in self.stars:
            depth = star.depth
            assert depth is not None
            coupling = star.chain.mT.to(depth.coupling) @ depth.coupling
            out[star.frame] += replace(depth, coupling=coupling).step(step[_rows(star, self.poses)])
        return out

    def covariance(self) -> Float[Tensor, "m m"]:
        """Of the block's unknowns, see :func:`solve_shared`."""
        H, free, first = self.hessian, self.free, 6 * self.poses
        out = H.new_zeros(len(H) - first, len(H) - first)
        chosen = free[free >= first] - first
        if not len(chosen) or len(self.stars) < 2:
            return out
        system = H[free[:, None], free]
        unit = H.new_zeros(len(free), len(chosen))
        unit[-len(chosen) :] = torch.eye(len(chosen), dtype=H.dtype)
        rows, info = torch.linalg.solve_ex(
            system + 1e-9 * torch.diag(system.diagonal().abs()), unit
        )
        if int(info):
            return out + torch.nan
        pull = H.new_zeros(len(H), len(chosen))
        pull[free] = rows
        gradients = ((_rows(s, self.poses), s.chain.mT @ s.gradient) for s in self.stars)
        each = torch.stack([pull[at].mT @ g for at, g in gradients])
        each = each - each.mean(0)
        share = len(self.stars) / (len(self.stars) - 1) * each.mT @ each
        out[chosen[:, None], chosen] = share
        return out


def _star(
    problem: BundleProblem,
    block: SharedBlock,
    T: Float[Tensor, "n 4 4"],
    d: Float[Tensor, "n p"],
    e: slice,
    huber: float,
    depth_damping: float,
) -> tuple[Star, Float[Tensor, "c"]]:
    """A source with its edges, and the diagonal of its chained equations with depths fixed."""
    source, targets, shared = problem.source[e], problem.target[e], len(block.free)
    p = block.linearise(T, source, targets, d[source])
    r, weight = weighed_residuals(p, problem.pixels[e], problem.weight[e], huber)
    w, J, Jd = weight.mT[:, None], p.jacobian, p.depth_jacobian
    wJ = J * w
    H = (wJ.flatten(2) @ J.flatten(2).mT).double().cpu()
    v = (wJ * r.mT[:, None]).sum((2, 3)).double().cpu()
    E = (wJ * Jd[:, None]).sum(2)
    wd = Jd * w[:, 0]
    information, b = (wd * Jd).sum((0, 1)), (wd * r.mT).sum((0, 1))
    # Relative motions of the edges, then the unknowns that they share.
    at = 6 * len(targets)
    hessian = torch.zeros(at + shared, at + shared, dtype=torch.float64)
    hessian[:at, :at] = torch.block_diag(*H[:, :6, :6])
    hessian[:at, at:] = H[:, :6, 6:].reshape(at, shared)
    hessian[at:, :at] = hessian[:at, at:].mT
    hessian[at:, at:] = H[:, 6:, 6:].sum(0)
    gradient = torch.cat([v[:, :6].reshape(-1), v[:, 6:].sum(0)])
    depth = EliminatedDepth(
        torch.cat([E[:, :6].flatten(0, 1), E[:, 6:].sum(0)]),
        damped_curvature(information, depth_damping),
        b,
    )
    adjoint = se3_adjoint(relative_motion(T, source, targets))
    equations = depth.reduce(hessian, gradient)
    residual, frame = edge_residual(r, weight), int(source[0])
    star = Star(frame, targets, adjoint, *equations, information, residual, depth)
    return star, (star.chain.mT @ hessian @ star.chain).diagonal()


def _rows(star: Star, frames: int) -> Int[Tensor, "c"]:
    """Where a star's unknowns stand among the poses of all ``frames`` and what is shared."""
    poses = (6 * star.poses[:, None] + torch.arange(6)).reshape(-1)
    return torch.cat([poses, 6 * frames + torch.arange(star.shared)])
