"""Dense bundle adjustment whose variables are also the focal length and a radial term.

Levenberg-Marquardt on the tracker's cost (:mod:`geogs.bundle.dense`) with the lens beside poses
and inverse depths: depths are eliminated frame by frame, then poses and lens are solved together
in float64. The first pose is fixed; the scale, which nothing measures, is held by a penalty along
it, so that nothing else resists the lens.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.lens import UNKNOWNS, Lens, LensRays, lens_rays, linearise_lens, project_lens
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
class LensBundleOptions:
    """How a problem is solved."""

    iterations: int = 15
    """Linearisations, at most."""
    huber: float = 3.0
    """Standard deviations beyond which a residual counts linearly."""
    radial: bool = False
    """Whether k1 is a variable."""
    focal: bool = True
    """Whether the focal length is a variable."""
    damping: float = 1e-3
    """Levenberg damping at the start, relative to the diagonal."""
    least_decrease: float = 1e-4
    """Share of the cost; less ends the iteration."""
    depth_damping: float = 1e-5
    """Added to the curvature of each inverse depth, relative to the mean of its frame."""
    min_inverse_depth: float = 1e-3
    max_inverse_depth: float = 1e2

    @property
    def free(self) -> list[int]:
        """Which unknowns of the lens are variables."""
        return [0] * self.focal + [1] * self.radial


@dataclass(frozen=True)
class LensBundleResult:
    """The adjusted problem, and how well the lens is known."""

    lens: Lens
    T_cw: Float[Tensor, "n 4 4"]
    inverse_depth: Float[Tensor, "n p"]
    information: Float[Tensor, "n p"]
    """Sum over a frame's edges of w |dp/dd|^2 before the last step."""
    cost: float
    """Mean over the matched cells of Huber's cost of a residual, in variances of a match."""
    covariance: Float[Tensor, "2 2"]
    """Of log f and k1 (zero for those that are no variables), see :func:`solve_lens`."""
    finite: bool


def solve_lens(
    problem: BundleProblem,
    lens: Lens,
    pixels: Float[Tensor, "p 2"],
    options: LensBundleOptions | None = None,
) -> LensBundleResult:
    """Adjust all free poses, all inverse depths and the lens; every frame's depth is free.

    ``pixels`` are the cells' own. The covariance is cluster-robust (Liang and Zeger's sandwich):
    ``S^-1 (sum_i g_i g_i^T) S^-1`` with the reduced gradient ``g_i`` of each source frame, since
    the errors of neighbouring cells, and of one cell in several targets, are alike; no noise level
    and no count of independent cells is needed. A step that is not finite ends the adjustment.
    """
    options = options or LensBundleOptions()
    T, d = problem.T_cw, problem.inverse_depth
    damping, finite = options.damping, True
    cost = robust_cost(problem, lens, pixels, T, d, options.huber)
    system = _System.of(problem, lens, pixels, T, d, options)
    for _ in range(options.iterations):
        step = system.step(damping)
        if step is None:
            finite = False
            break
        moved_lens = lens.moved(float(step[-2]), float(step[-1]))
        xi = step[:-UNKNOWNS].reshape(-1, 6)
        moved_T = torch.where(problem.free_pose[:, None, None], move(xi, T), T)
        moved_d = system.moved_depth(step, d, options)
        moved_cost = robust_cost(problem, moved_lens, pixels, moved_T, moved_d, options.huber)
        if not moved_cost < cost:
            damping = max(damping, 1e-6) * 10
            if damping > 1e3:
                break
            continue
        done = cost - moved_cost < options.least_decrease * cost
        lens, T, d, cost = moved_lens, moved_T, moved_d, moved_cost
        system = _System.of(problem, lens, pixels, T, d, options)
        damping = damping / 10
        if done:
            break
    information = torch.zeros_like(d)
    for star in system.stars:
        information[star.frame] = star.information
    covariance = system.covariance(options.free)
    finite = finite and bool(torch.isfinite(covariance).all())
    return LensBundleResult(lens, T, d, information, cost, covariance, finite)


def robust_cost(
    problem: BundleProblem,
    lens: Lens,
    pixels: Float[Tensor, "p 2"],
    T_cw: Float[Tensor, "n 4 4"],
    inverse_depth: Float[Tensor, "n p"],
    huber: float,
) -> float:
    """Mean of Huber's cost over the matched cells; one behind its target counts as 10 hubers off.

    Infinite where nothing is matched.
    """
    rays = lens_rays(lens, pixels).rays
    T_ji = relative_motion(T_cw, problem.source, problem.target)
    at = project_lens(lens, rays, T_ji, inverse_depth[problem.source])
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
class _System:
    """The problem linearised at one state, over all poses, then the lens."""

    stars: list[Star]
    hessian: Float[Tensor, "v v"]
    """Depths eliminated, the scale held; float64."""
    gradient: Float[Tensor, "v"]
    free: Int[Tensor, "f"]
    """Which of its rows may move."""

    @staticmethod
    def of(
        problem: BundleProblem,
        lens: Lens,
        pixels: Float[Tensor, "p 2"],
        T: Float[Tensor, "n 4 4"],
        d: Float[Tensor, "n p"],
        options: LensBundleOptions,
    ) -> "_System":
        """Sum the stars of all sources up."""
        rays, n = lens_rays(lens, pixels), len(T)
        size = 6 * n + UNKNOWNS
        H = torch.zeros(size, size, dtype=torch.float64)
        diagonal, g = H.new_zeros(size), H.new_zeros(size)
        stars = []
        for frame, e in sources_within(problem.source):
            star, curvature = _star(problem, lens, rays, T, d, frame, e, options)
            rows = _rows(star, n)
            hessian, gradient = star.chained()
            H[rows[:, None], rows] += hessian
            diagonal[rows] += curvature
            g[rows] += gradient
            stars.append(star)
        centre = se3_inverse(T[0])[:3, 3]
        away = (T[:, :3, :3] @ centre + T[:, :3, 3]).double().cpu()
        scale = torch.cat([torch.cat([away, 0 * away], 1).reshape(-1), H.new_zeros(UNKNOWNS)])
        scale = scale / scale.norm().clamp(min=1e-12)
        H = H + diagonal.mean() * scale[:, None] * scale
        free = torch.zeros(size, dtype=torch.bool)
        free[: 6 * n] = problem.free_pose.cpu().repeat_interleave(6)
        free[[6 * n + u for u in options.free]] = True
        return _System(stars, H, g, torch.nonzero(free)[:, 0])

    def step(self, damping: float) -> Float[Tensor, "v"] | None:
        """The damped step of all unknowns; None where it cannot be had."""
        H, g, free = self.hessian, self.gradient, self.free
        system = H[free[:, None], free] + torch.diag(damping * H.diagonal()[free].abs() + 1e-6)
        factor, info = torch.linalg.cholesky_ex(system)
        step = torch.zeros_like(g)
        if int(info):
            return None
        step[free] = torch.cholesky_solve(g[free, None], factor)[:, 0]
        step[-UNKNOWNS:] = step[-UNKNOWNS:].clamp(-0.3, 0.3)
        return step if bool(torch.isfinite(step).all()) else None

    def moved_depth(
        self, step: Float[Tensor, "v"], d: Float[Tensor, "n p"], options: LensBundleOptions
    ) -> Float[Tensor, "n p"]:
        """Inverse depths after a step of everything."""
        out = d.clone()
        for star in self.stars:
            depth = star.depth
            assert depth is not None
            coupling = star.chain.mT.to(depth.coupling) @ depth.coupling
            out[star.frame] += replace(depth, coupling=coupling).step(step[_rows(star, len(d))])
        return out.clamp(options.min_inverse_depth, options.max_inverse_depth)

    def covariance(self, chosen: list[int]) -> Float[Tensor, "2 2"]:
        """Of the chosen unknowns of the lens, see :func:`solve_lens`."""
        H, free = self.hessian, self.free
        out = H.new_zeros(UNKNOWNS, UNKNOWNS)
        if not chosen or len(self.stars) < 2:
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
        n = (len(H) - UNKNOWNS) // 6
        each = torch.stack([pull[_rows(s, n)].mT @ (s.chain.mT @ s.gradient) for s in self.stars])
        each = each - each.mean(0)
        index = torch.tensor(chosen)
        share = len(self.stars) / (len(self.stars) - 1) * each.mT @ each
        out[index[:, None], index] = share
        return out


def _star(
    problem: BundleProblem,
    lens: Lens,
    rays: LensRays,
    T: Float[Tensor, "n 4 4"],
    d: Float[Tensor, "n p"],
    frame: int,
    e: slice,
    options: LensBundleOptions,
) -> tuple[Star, Float[Tensor, "c"]]:
    """A source with its edges, and the diagonal of its chained equations with depths fixed."""
    targets, k = problem.target[e], e.stop - e.start
    T_ji = relative_motion(T, problem.source[e], targets)
    p = linearise_lens(lens, rays, T_ji, d[frame].expand(k, -1))
    r, weight = weighed_residuals(p, problem.pixels[e], problem.weight[e], options.huber)
    w, J, Jd = weight.mT[:, None], p.jacobian, p.depth_jacobian
    wJ = J * w
    H = (wJ.flatten(2) @ J.flatten(2).mT).double().cpu()
    v = (wJ * r.mT[:, None]).sum((2, 3)).double().cpu()
    E = (wJ * Jd[:, None]).sum(2)
    wd = Jd * w[:, 0]
    information, b = (wd * Jd).sum((0, 1)), (wd * r.mT).sum((0, 1))
    # Relative motions of the edges, then the lens that they share.
    at = 6 * k
    hessian = torch.zeros(at + UNKNOWNS, at + UNKNOWNS, dtype=torch.float64)
    hessian[:at, :at] = torch.block_diag(*H[:, :6, :6])
    hessian[:at, at:] = H[:, :6, 6:].reshape(at, UNKNOWNS)
    hessian[at:, :at] = hessian[:at, at:].mT
    hessian[at:, at:] = H[:, 6:, 6:].sum(0)
    gradient = torch.cat([v[:, :6].reshape(-1), v[:, 6:].sum(0)])
    depth = EliminatedDepth(
        torch.cat([E[:, :6].flatten(0, 1), E[:, 6:].sum(0)]),
        damped_curvature(information, options.depth_damping),
        b,
    )
    residual, adjoint = edge_residual(r, weight), se3_adjoint(T_ji)
    star = Star(
        frame, targets, adjoint, *depth.reduce(hessian, gradient), information, residual, depth
    )
    return star, (star.chain.mT @ hessian @ star.chain).diagonal()


def _rows(star: Star, frames: int) -> Int[Tensor, "c"]:
    """Where a star's unknowns stand among the poses of all ``frames`` and the lens."""
    poses = (6 * star.poses[:, None] + torch.arange(6)).reshape(-1)
    return torch.cat([poses, 6 * frames + torch.arange(UNKNOWNS)])
