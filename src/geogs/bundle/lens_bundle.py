"""Dense bundle adjustment whose variables are also the focal length and a radial term.

Levenberg-Marquardt on the tracker's cost (:mod:`geogs.bundle.dense`) with the lens beside poses
and inverse depths: depths are eliminated frame by frame, then poses and lens are solved together
in float64. The first pose is fixed; the scale, which nothing measures, is held by a penalty along
it, so that nothing else resists the lens.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.dense import BundleProblem, move, relative_motion, robust_weight
from geogs.bundle.lens import (
    UNKNOWNS,
    Lens,
    lens_rays,
    linearise_lens,
    project_lens,
)
from geogs.geometry.lie import se3_adjoint, se3_inverse


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


@dataclass(frozen=True)
class _Star:
    """A source frame with its edges; its inverse depths eliminated."""

    poses: Tensor
    """(k + 1,): the targets and the frame itself."""
    hessian: Tensor
    """Over (their poses, lens), float64, depths eliminated."""
    diagonal: Tensor
    """Of the same with the depths fixed."""
    gradient: Tensor
    coupling: Tensor
    """Rows over (poses, lens), columns over cells."""
    curvature: Tensor
    depth_gradient: Tensor
    information: Tensor


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
    stars: list[_Star] = []
    is_fresh = False
    for _ in range(options.iterations):
        if not is_fresh:
            stars = _stars(problem, lens, pixels, T, d, options)
        step = _step(problem, stars, T, options, damping)
        if step is None:
            finite = False
            break
        moved_lens = lens.moved(float(step[-2]), float(step[-1]))
        xi = step[:-UNKNOWNS].reshape(-1, 6)
        moved_T = torch.where(problem.free_pose[:, None, None], move(xi, T), T)
        moved_d = _moved_depth(stars, step, d, options)
        moved_cost = robust_cost(problem, moved_lens, pixels, moved_T, moved_d, options.huber)
        is_fresh = not moved_cost < cost
        if is_fresh:
            damping = max(damping, 1e-6) * 10
            if damping > 1e3:
                break
            continue
        done = cost - moved_cost < options.least_decrease * cost
        lens, T, d, cost = moved_lens, moved_T, moved_d, moved_cost
        damping = damping / 10
        if done:
            break
    stars = _stars(problem, lens, pixels, T, d, options)
    information = torch.zeros_like(d)
    for star in stars:
        information[star.poses[-1]] = star.information
    covariance = _covariance(problem, stars, T, options)
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
    at, valid = project_lens(lens, rays, T_ji, inverse_depth[problem.source])
    norm = (problem.weight * (problem.pixels - at).square()).sum(-1).sqrt()
    norm = torch.where(valid, norm, torch.full_like(norm, 10 * huber))
    cost = torch.where(norm < huber, norm.square(), 2 * huber * norm - huber**2)
    matched = problem.weight[..., 0] > 0
    return (
        float((cost * matched).sum(dtype=torch.float64) / matched.sum())
        if bool(matched.any())
        else float("inf")
    )


def _stars(
    problem: BundleProblem,
    lens: Lens,
    pixels: Tensor,
    T: Tensor,
    d: Tensor,
    options: LensBundleOptions,
) -> list[_Star]:
    rays = lens_rays(lens, pixels)
    frames, counts = torch.unique_consecutive(problem.source, return_counts=True)
    ends = counts.cumsum(0).tolist()
    stars = []
    for frame, start, end in zip(frames.tolist(), [0, *ends], ends, strict=False):
        e = slice(start, end)
        T_ji = relative_motion(T, problem.source[e], problem.target[e])
        p = linearise_lens(lens, rays, T_ji, d[frame].expand(end - start, -1))
        r = problem.pixels[e] - p.pixels
        w = robust_weight(r, problem.weight[e] * p.valid[..., None], options.huber).mT[:, None]
        stars.append(
            _star(problem.target[e], frame, T_ji, p.jacobian, p.depth_jacobian, r, w, options)
        )
    return stars


def _star(
    targets: Tensor,
    frame: int,
    T_ji: Tensor,
    J: Float[Tensor, "k 8 2 p"],
    Jd: Float[Tensor, "k 2 p"],
    r: Float[Tensor, "k p 2"],
    w: Float[Tensor, "k 1 2 p"],
    options: LensBundleOptions,
) -> _Star:
    k, p = len(targets), J.shape[-1]
    wJ = J * w
    H = (wJ.flatten(2) @ J.flatten(2).mT).double().cpu()
    v = (wJ * r.mT[:, None]).sum((2, 3)).double().cpu()
    E = (wJ * Jd[:, None]).sum(2)
    wd = Jd * w[:, 0]
    information, b = (wd * Jd).sum((0, 1)), (wd * r.mT).sum((0, 1))
    curvature = information + options.depth_damping * information.mean() + 1e-8
    # Relative motions of the edges, then the lens that they share; xi_rel = xi_j - Ad xi_i.
    hessian = torch.zeros(6 * k + UNKNOWNS, 6 * k + UNKNOWNS, dtype=torch.float64)
    hessian[: 6 * k, : 6 * k] = torch.block_diag(*H[:, :6, :6])
    hessian[: 6 * k, 6 * k :] = H[:, :6, 6:].reshape(6 * k, UNKNOWNS)
    hessian[6 * k :, : 6 * k] = hessian[: 6 * k, 6 * k :].mT
    hessian[6 * k :, 6 * k :] = H[:, 6:, 6:].sum(0)
    gradient = torch.cat([v[:, :6].reshape(-1), v[:, 6:].sum(0)])
    coupling = torch.cat([E[:, :6].reshape(6 * k, p), E[:, 6:].sum(0)])
    chain = _chain(se3_adjoint(T_ji))
    full = chain.mT @ hessian @ chain
    reduced = hessian - ((coupling / curvature) @ coupling.mT).double().cpu()
    gradient = gradient - (coupling @ (b / curvature)).double().cpu()
    return _Star(
        torch.cat([targets, targets.new_tensor([frame])]),
        chain.mT @ reduced @ chain,
        full.diagonal(),
        chain.mT @ gradient,
        chain.mT.to(coupling) @ coupling,
        curvature,
        b,
        information,
    )


def _chain(adjoint: Float[Tensor, "k 6 6"]) -> Float[Tensor, "a b"]:
    """From (poses of the targets, pose of the source, lens) to (relative motions, lens)."""
    k = len(adjoint)
    eye = torch.eye(6 * k, dtype=torch.float64)
    poses = torch.cat([eye, -adjoint.double().cpu().reshape(6 * k, 6)], 1)
    return torch.block_diag(poses, torch.eye(UNKNOWNS, dtype=torch.float64))


def _rows(star: _Star, frames: int) -> Tensor:
    """Where a star's variables stand among those of all ``frames`` and the lens."""
    poses = (6 * star.poses[:, None].cpu() + torch.arange(6)).reshape(-1)
    return torch.cat([poses, 6 * frames + torch.arange(UNKNOWNS)])


def _free(problem: BundleProblem, options: LensBundleOptions) -> Tensor:
    """Indices of the variables that may move."""
    lens = torch.zeros(UNKNOWNS, dtype=torch.bool)
    lens[options.free] = True
    free = torch.cat([problem.free_pose.cpu().repeat_interleave(6), lens])
    return torch.nonzero(free)[:, 0]


def _system(
    problem: BundleProblem, stars: list[_Star], T: Tensor
) -> tuple[Float[Tensor, "v v"], Float[Tensor, "v"], Float[Tensor, "v"]]:
    """Reduced Hessian with the scale held, its diagonal with fixed depths, and gradient."""
    n = len(problem.T_cw)
    size = 6 * n + UNKNOWNS
    H = torch.zeros(size, size, dtype=torch.float64)
    diagonal, g = H.new_zeros(size), H.new_zeros(size)
    for star in stars:
        rows = _rows(star, n)
        H[rows[:, None], rows] += star.hessian
        diagonal[rows] += star.diagonal
        g[rows] += star.gradient
    centre = se3_inverse(T[0])[:3, 3]
    away = (T[:, :3, :3] @ centre + T[:, :3, 3]).double().cpu()
    scale = torch.cat([torch.cat([away, 0 * away], 1).reshape(-1), H.new_zeros(UNKNOWNS)])
    scale = scale / scale.norm().clamp(min=1e-12)
    H = H + diagonal.mean() * scale[:, None] * scale
    return H, diagonal, g


def _step(
    problem: BundleProblem,
    stars: list[_Star],
    T: Tensor,
    options: LensBundleOptions,
    damping: float,
) -> Float[Tensor, "v"] | None:
    """The damped step of all variables; None where it cannot be had."""
    H, _, g = _system(problem, stars, T)
    free = _free(problem, options)
    system = H[free[:, None], free] + torch.diag(damping * H.diagonal()[free].abs() + 1e-6)
    factor, info = torch.linalg.cholesky_ex(system)
    step = torch.zeros_like(g)
    if int(info):
        return None
    step[free] = torch.cholesky_solve(g[free, None], factor)[:, 0]
    step[-UNKNOWNS:] = step[-UNKNOWNS:].clamp(-0.3, 0.3)
    return step if bool(torch.isfinite(step).all()) else None


def _moved_depth(
    stars: list[_Star], step: Tensor, d: Tensor, options: LensBundleOptions
) -> Float[Tensor, "n p"]:
    """Back-substitution: (b - E^T step) / C of every star."""
    out = d.clone()
    n = (len(step) - UNKNOWNS) // 6
    for star in stars:
        moved = star.coupling.mT @ step[_rows(star, n)].to(d)
        out[star.poses[-1]] += (star.depth_gradient - moved) / star.curvature
    return out.clamp(options.min_inverse_depth, options.max_inverse_depth)


def _covariance(
    problem: BundleProblem, stars: list[_Star], T: Tensor, options: LensBundleOptions
) -> Float[Tensor, "2 2"]:
    H, _, _ = _system(problem, stars, T)
    out = H.new_zeros(UNKNOWNS, UNKNOWNS)
    free, chosen = _free(problem, options), options.free
    if not chosen or len(stars) < 2:
        return out
    system = H[free[:, None], free]
    unit = H.new_zeros(len(free), len(chosen))
    unit[-len(chosen) :] = torch.eye(len(chosen), dtype=H.dtype)
    rows, info = torch.linalg.solve_ex(system + 1e-9 * torch.diag(system.diagonal().abs()), unit)
    if int(info):
        return out + torch.nan
    pull = H.new_zeros(len(H), len(chosen))
    pull[free] = rows
    n = len(problem.T_cw)
    each = torch.stack([pull[_rows(star, n)].mT @ star.gradient for star in stars])
    each = each - each.mean(0)
    share = len(stars) / (len(stars) - 1) * each.mT @ each
    index = torch.tensor(chosen)
    out[index[:, None], index] = share
    return out
