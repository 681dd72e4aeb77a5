"""Dense bundle adjustment over poses and inverse depths.

Gauss-Newton on ``sum_e sum_p rho(|W^(1/2) (target - project(T_j T_i^-1, d_i))|)``, DROID-SLAM's
dense BA layer. Each edge is linearised in the motion of its target relative to its source, so only
one Jacobian is formed; the chain to both poses, ``xi_rel = xi_j - Ad(T_ji) xi_i``, is applied to
the small reduced blocks. Residuals are float32, the reduced camera system is float64.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.lie import (
    matrix_to_quaternion,
    quaternion_to_matrix,
    retract,
    se3_adjoint,
    se3_inverse,
)
from geogs.keyframes.grid import SampleGrid
from geogs.threads import thread_map

MIN_Z = 0.05
"""Points nearer than this fraction of the source's unit depth behind the target are ignored."""


@dataclass(frozen=True)
class Projection:
    """Where the cells of the sources fall in the targets, and how that changes."""

    pixels: Float[Tensor, "e p 2"]
    valid: Bool[Tensor, "e p"]
    z: Float[Tensor, "e p"]
    """Depth in the target over depth in the source, at least ``MIN_Z``."""


@dataclass(frozen=True)
class LinearProjection(Projection):
    """A projection with its first derivatives."""

    pose_jacobian: Float[Tensor, "e 6 2 p"]
    """d pixel / d xi of the target pose (left perturbation), laid out for the products below."""
    depth_jacobian: Float[Tensor, "e p 2"]
    """d pixel / d inverse depth of the source."""


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


@dataclass(frozen=True)
class BundleOptions:
    """How a problem is solved."""

    iterations: int = 2
    huber: float = 3.0
    """Standard deviations beyond which a residual counts linearly."""
    damping: float = 1e-4
    """Levenberg damping relative to the diagonal of the reduced system."""
    depth_damping: float = 1e-3
    """Damping of inverse depth relative to the mean curvature of its frame."""
    chunk: int = 24
    """Edges linearised at a time; bounds memory."""
    min_inverse_depth: float = 1e-3
    max_inverse_depth: float = 1e2
    tolerance: float = 0.0
    """On the CPU, a step that moves no pose by this much (units, radians) is the last one."""


@dataclass(frozen=True)
class BundleResult:
    """The adjusted problem."""

    T_cw: Float[Tensor, "n 4 4"]
    inverse_depth: Float[Tensor, "n p"]
    information: Float[Tensor, "n p"]
    """Sum over a frame's edges of w |dp/dd|^2 before the last step."""
    residual: Float[Tensor, "e"]
    """Root of the robustly weighted mean squared residual of each edge in pixels."""
    finite: bool


def project(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_ji: Float[Tensor, "e 4 4"],
    inverse_depth: Float[Tensor, "e p"],
) -> Projection:
    """Project the cells of source frames with inverse depth d: p = pi(K (R ray + d t)).

    Points with R ray + d t closer than ``MIN_Z`` are flagged and held at that depth.
    """
    R, t = T_ji[:, :3, :3].to(inverse_depth), T_ji[:, :3, 3].to(inverse_depth)
    y = rays @ R.mT + inverse_depth[..., None] * t[:, None]
    valid = y[..., 2] > MIN_Z
    z = y[..., 2].clamp(min=MIN_Z)
    pixels = torch.stack(
        [camera.fx * y[..., 0] / z + camera.cx, camera.fy * y[..., 1] / z + camera.cy], -1
    )
    return Projection(pixels, valid, z)


def linearise(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_ji: Float[Tensor, "e 4 4"],
    inverse_depth: Float[Tensor, "e p"],
) -> LinearProjection:
    """:func:`project` with the Jacobians in a left perturbation of T_ji and in d.

    Source: DROID-SLAM's reprojection layer.
    """
    p = project(camera, rays, T_ji, inverse_depth)
    t, q = T_ji[:, :3, 3].to(inverse_depth), 1 / p.z
    x = (p.pixels[..., 0] - camera.cx) / camera.fx
    v = (p.pixels[..., 1] - camera.cy) / camera.fy
    dq = inverse_depth * q
    o = torch.zeros_like(q)
    row_x = torch.stack([dq, o, -x * dq, -x * v, 1 + x * x, -v], 1) * camera.fx
    row_y = torch.stack([o, dq, -v * dq, -1 - v * v, x * v, x], 1) * camera.fy
    tx, ty, tz = t[:, None].unbind(-1)
    depth = torch.stack([camera.fx * (tx - tz * x) * q, camera.fy * (ty - tz * v) * q], -1)
    return LinearProjection(p.pixels, p.valid, p.z, torch.stack([row_x, row_y], 2), depth)


def robust_weight(
    residual: Float[Tensor, "*b 2"], weight: Float[Tensor, "*b 2"], huber: float
) -> Float[Tensor, "*b 2"]:
    """Weights times Huber's factor ``min(1, huber / |W^(1/2) residual|)``."""
    norm = (weight * residual.square()).sum(-1, keepdim=True).sqrt()
    return weight * (huber / norm.clamp(min=huber))


def move(xi: Float[Tensor, "*b 6"], T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Left retraction whose rotation is made orthonormal again.

    Inverses are taken by transposition, so rounding errors would otherwise feed on themselves.
    """
    T = retract(xi, T)
    R = quaternion_to_matrix(matrix_to_quaternion(T[..., :3, :3]))
    return torch.cat([torch.cat([R, T[..., :3, 3:]], -1), T[..., 3:, :]], -2)


def relative_motion(
    T_cw: Float[Tensor, "n 4 4"], source: Int[Tensor, "e"], target: Int[Tensor, "e"]
) -> Float[Tensor, "e 4 4"]:
    """T_ji = T_j T_i^-1 of every edge i -> j."""
    return T_cw[target] @ se3_inverse(T_cw[source])


@dataclass(frozen=True)
class Star:
    """A source frame with all its edges, linearised, its inverse depths eliminated if free."""

    frame: int
    targets: Tensor
    adjoint: Tensor
    hessian: Tensor
    """(6k, 6k) float64 over the relative motions of its k edges."""
    gradient: Tensor
    """(6k,) float64."""
    information: Tensor
    """(p,): sum of w |dp/dd|^2."""
    residual: Tensor
    """(k,)."""
    depth: tuple[Tensor, Tensor, Tensor] | None
    """Coupling (6k, p), damped curvature (p,) and gradient (p,) of free inverse depths."""


@runtime_checkable
class BundleSolver(Protocol):
    """What adjusts a problem."""

    def solve(self, problem: BundleProblem, options: BundleOptions | None = None) -> BundleResult:
        """Take ``options.iterations`` steps; one that is not finite is not taken."""
        ...


def bundle_solver(grid: SampleGrid) -> BundleSolver:
    """The solver for the device of a grid."""
    if grid.on_gpu:
        from geogs.bundle.cuda.bundle import CudaDenseBundle

        return CudaDenseBundle(grid)
    return DenseBundle(grid)


class DenseBundle:
    """Solver for one grid on the CPU; holds no state between calls."""

    def __init__(self, grid: SampleGrid) -> None:
        self.grid = grid

    def solve(self, problem: BundleProblem, options: BundleOptions | None = None) -> BundleResult:
        """Take ``options.iterations`` damped Gauss-Newton steps.

        A step that is not finite is not taken and ``finite`` is False in the result.
        """
        options = options or BundleOptions()
        T, d = problem.T_cw, problem.inverse_depth
        information = torch.zeros_like(d)
        residual = d.new_zeros(len(problem.source))
        finite = True
        for _ in range(options.iterations):
            stars = self._linearise(problem, T, d, options)
            for star in stars:
                information[star.frame] = star.information
            residual = torch.cat([star.residual for star in stars]) if stars else residual
            xi = _pose_step(problem, stars, options.damping)
            delta = _depth_step(stars, xi, d)
            if not bool(torch.isfinite(xi).all() and torch.isfinite(delta).all()):
                finite = False
                break
            T = torch.where(problem.free_pose[:, None, None], move(xi, T), T)
            d = (d + delta).clamp(options.min_inverse_depth, options.max_inverse_depth)
            d = torch.where(problem.free_depth[:, None], d, problem.inverse_depth)
            if float(xi.abs().max()) < options.tolerance:
                break
        return BundleResult(T, d, information, residual, finite)

    def _linearise(
        self, problem: BundleProblem, T: Tensor, d: Tensor, options: BundleOptions
    ) -> list[Star]:
        """All stars; chunks of them side by side on the CPU, always in the same order."""
        chunks = source_chunks(problem.source, options.chunk)

        def work(chunk: slice) -> list[Star]:
            return linearise_stars(self.grid, problem, T, d, options, chunk)

        parts = thread_map(work, chunks) if d.device.type == "cpu" else map(work, chunks)
        return [star for part in parts for star in part]


def linearise_stars(
    grid: SampleGrid,
    problem: BundleProblem,
    T: Float[Tensor, "n 4 4"],
    d: Float[Tensor, "n p"],
    options: BundleOptions,
    chunk: slice,
) -> list[Star]:
    """The stars of some edges of a problem at the given poses and inverse depths."""
    i, j = problem.source[chunk], problem.target[chunk]
    T_ji = relative_motion(T, i, j)
    p = linearise(grid.camera, grid.rays, T_ji, d[i])
    r = problem.pixels[chunk] - p.pixels
    w = robust_weight(r, problem.weight[chunk] * p.valid[..., None], options.huber)
    wJ = p.pose_jacobian * w.mT[:, None]
    H, v = normal_equations(wJ, p.pose_jacobian, r)
    coupling = (wJ * p.depth_jacobian.mT[:, None]).sum(2)
    curvature = (w * p.depth_jacobian.square()).sum(-1)
    depth_gradient = (w * p.depth_jacobian * r).sum(-1)
    adjoint, residual = se3_adjoint(T_ji), _edge_residual(r, w)
    stars = []
    for frame, e in sources_within(i):
        block, g, c = torch.block_diag(*H[e]), v[e].reshape(-1), curvature[e].sum(0)
        depth = None
        if bool(problem.free_depth[frame]):
            damped = damped_curvature(problem, frame, c, options)
            E, b = coupling[e].flatten(0, 1), depth_gradient[e].sum(0)
            depth = (E, damped, b)
            block = block - ((E / damped) @ E.mT).double()
            g = g - (E @ (b / damped)).double()
        stars.append(Star(frame, j[e], adjoint[e], block, g, c, residual[e], depth))
    return stars


def sources_within(source: Int[Tensor, "e"]) -> list[tuple[int, slice]]:
    """The sources of sorted edges and which edges are theirs."""
    frames, counts = torch.unique_consecutive(source, return_counts=True)
    found, start = [], 0
    for frame, count in zip(frames.tolist(), counts.tolist(), strict=True):
        found.append((frame, slice(start, start + count)))
        start += count
    return found


def damped_curvature(
    problem: BundleProblem, frame: int, curvature: Float[Tensor, "p"], options: BundleOptions
) -> Float[Tensor, "p"]:
    """Curvature of a frame's inverse depths with all that resists their change."""
    damped = curvature + options.depth_damping * curvature.mean() + 1e-8
    return damped if problem.damping is None else damped + problem.damping[frame]


def normal_equations(
    wJ: Float[Tensor, "e 6 2 p"], J: Float[Tensor, "e 6 2 p"], residual: Float[Tensor, "e p 2"]
) -> tuple[Float[Tensor, "e 6 6"], Float[Tensor, "e 6"]]:
    """J^T W J and J^T W r of every edge, summed over its cells."""
    left = wJ.flatten(2)
    right = torch.cat([J.flatten(2), residual.mT.flatten(1)[:, None]], 1)
    both = (left @ right.mT).double()
    return both[..., :6], both[..., 6]


def _edge_residual(residual: Tensor, weight: Tensor) -> Tensor:
    total = weight.sum((1, 2)).clamp(min=1e-12)
    return ((weight * residual.square()).sum((1, 2)) / total * 2).sqrt()


def source_chunks(source: Int[Tensor, "e"], size: int) -> list[slice]:
    """Slices of about ``size`` edges that never split the edges of one source."""
    if not len(source):
        return []
    cut = (torch.nonzero(source[1:] != source[:-1])[:, 0] + 1).tolist()
    chunks, start, last = [], 0, 0
    for end in [*cut, len(source)]:
        if end - start > size and last > start:
            chunks.append(slice(start, last))
            start = last
        last = end
    return [*chunks, slice(start, last)]


def _pose_step(problem: BundleProblem, stars: list[Star], damping: float) -> Float[Tensor, "n 6"]:
    """Solve the camera system; steps of all frames, zero for the fixed, NaN where it cannot be."""
    free = problem.free_pose
    n = int(free.sum())
    xi = torch.zeros(len(free), 6, dtype=torch.float64, device=free.device)
    if not n:
        return xi
    slot = torch.full((len(free),), -1, dtype=torch.long, device=free.device)
    slot[free] = torch.arange(n, device=free.device)
    H, g = xi.new_zeros(n, n, 6, 6), xi.new_zeros(n, 6)
    for star in stars:
        poses, block, gradient = chain_star(star)
        at = slot[poses]
        keep = at >= 0
        at = at[keep]
        g.index_add_(0, at, gradient[keep])
        rows, columns = at[:, None].expand(-1, len(at)), at[None].expand(len(at), -1)
        H.index_put_((rows, columns), block[keep][:, keep], accumulate=True)
    H = H.transpose(1, 2).reshape(6 * n, 6 * n)
    H = H + torch.diag(damping * H.diagonal().abs() + 1e-2)
    factor, info = torch.linalg.cholesky_ex(H)
    solution = torch.cholesky_solve(g.reshape(-1, 1), factor)
    xi[free] = solution.reshape(n, 6) if not int(info) else torch.nan
    return xi


def chain_star(
    star: Star,
) -> tuple[Int[Tensor, "k1"], Float[Tensor, "k1 k1 6 6"], Float[Tensor, "k1 6"]]:
    """A star over its poses, by xi_rel = xi_target - Ad xi_source: poses, blocks, gradient."""
    k = len(star.targets)
    poses = torch.cat([star.targets, star.targets.new_tensor([star.frame])])
    eye = torch.eye(6 * k, dtype=torch.float64, device=star.hessian.device)
    chain = torch.cat([eye, -star.adjoint.reshape(6 * k, 6)], 1)
    block = (chain.mT @ star.hessian @ chain).reshape(k + 1, 6, k + 1, 6).transpose(1, 2)
    return poses, block, (chain.mT @ star.gradient).reshape(k + 1, 6)


def _depth_step(
    stars: list[Star], xi: Float[Tensor, "n 6"], inverse_depth: Float[Tensor, "n p"]
) -> Float[Tensor, "n p"]:
    """Back-substitution: (b - E^T xi_rel) / C for every star."""
    delta = torch.zeros_like(inverse_depth)
    for star in stars:
        if star.depth is not None:
            coupling, curvature, gradient = star.depth
            relative = xi[star.targets] - star.adjoint @ xi[star.frame]
            moved = coupling.mT @ relative.reshape(-1).to(inverse_depth)
            delta[star.frame] = (gradient - moved) / curvature
    return delta
