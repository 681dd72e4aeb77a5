"""Dense bundle adjustment over poses and inverse depths.

Gauss-Newton on ``sum_e sum_p rho(|W^(1/2) (target - project(T_j T_i^-1, d_i))|)``, DROID-SLAM's
dense BA layer. Each edge is linearised in the motion of its target relative to its source, so only
one Jacobian is formed; the chain to both poses, ``xi_rel = xi_j - Ad(T_ji) xi_i``, is applied to
the small reduced blocks. Residuals are float32, the reduced camera system is float64.
"""

from dataclasses import dataclass

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
from geogs.tracking.grid import SampleGrid

MIN_Z = 0.05
"""Points nearer than this fraction of the source's unit depth behind the target are ignored."""


@dataclass(frozen=True)
class Projection:
    """Where the cells of the sources fall in the targets, and how that changes."""

    pixels: Float[Tensor, "e p 2"]
    valid: Bool[Tensor, "e p"]
    pose_jacobian: Float[Tensor, "e 6 2 p"] | None
    """d pixel / d xi of the target pose (left perturbation), laid out for the products below."""
    depth_jacobian: Float[Tensor, "e p 2"] | None
    """d pixel / d inverse depth of the source."""


@dataclass(frozen=True)
class BundleProblem:
    """Frames and edges of one adjustment; edges are sorted by source."""

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


@dataclass(frozen=True)
class BundleResult:
    """The adjusted problem."""

    T_cw: Float[Tensor, "n 4 4"]
    inverse_depth: Float[Tensor, "n p"]
    information: Float[Tensor, "n p"]
    """Sum over a frame's edges of w |dp/dd|^2 before the last step."""
    residual: Float[Tensor, "e"]
    """Root of the robustly weighted mean squared residual of each edge in pixels."""
    step: float
    """Largest change of a pixel position by the last pose update, estimated."""
    finite: bool


def project(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_ji: Float[Tensor, "e 4 4"],
    inverse_depth: Float[Tensor, "e p"],
    jacobians: bool = False,
) -> Projection:
    """Project the cells of source frames with inverse depth d: p = pi(K (R ray + d t)).

    Points with R ray + d t closer than ``MIN_Z`` are flagged and held at that depth. Jacobians are
    with respect to a left perturbation of T_ji and to d (DROID-SLAM, reprojection layer).
    """
    R, t = T_ji[:, :3, :3].to(inverse_depth), T_ji[:, :3, 3].to(inverse_depth)
    y = rays @ R.mT + inverse_depth[..., None] * t[:, None]
    valid = y[..., 2] > MIN_Z
    q = 1 / y[..., 2].clamp(min=MIN_Z)
    x, v = y[..., 0] * q, y[..., 1] * q
    pixels = torch.stack([camera.fx * x + camera.cx, camera.fy * v + camera.cy], -1)
    if not jacobians:
        return Projection(pixels, valid, None, None)
    dq = inverse_depth * q
    o = torch.zeros_like(q)
    row_x = torch.stack([dq, o, -x * dq, -x * v, 1 + x * x, -v], 1) * camera.fx
    row_y = torch.stack([o, dq, -v * dq, -1 - v * v, x * v, x], 1) * camera.fy
    tx, ty, tz = t[:, None].unbind(-1)
    depth = torch.stack([camera.fx * (tx - tz * x) * q, camera.fy * (ty - tz * v) * q], -1)
    return Projection(pixels, valid, torch.stack([row_x, row_y], 2), depth)


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
class _Star:
    """A source frame with its edges, linearised and reduced to relative motions."""

    frame: int
    targets: Tensor
    adjoint: Tensor
    coupling: Tensor
    """(6k, p): weighted product of pose and depth Jacobians."""
    curvature: Tensor
    """(p,), damped."""
    gradient: Tensor
    """(p,)."""


class DenseBundle:
    """Solver for one grid; holds no state between calls."""

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
        step, finite = 0.0, True
        for _ in range(options.iterations):
            reduced = _Reduced(problem, T.device)
            information, residual = self._linearise(problem, T, d, options, reduced)
            xi = reduced.solve(options.damping)
            delta = reduced.depth_step(xi, d)
            if not bool(torch.isfinite(xi).all() and torch.isfinite(delta).all()):
                finite = False
                break
            T = torch.where(problem.free_pose[:, None, None], move(xi, T), T)
            d = (d + delta).clamp(options.min_inverse_depth, options.max_inverse_depth)
            d = torch.where(problem.free_depth[:, None], d, problem.inverse_depth)
            step = float(xi.abs().max()) * self.grid.camera.fx if xi.numel() else 0.0
        return BundleResult(T, d, information, residual, step, finite)

    def _linearise(
        self,
        problem: BundleProblem,
        T: Tensor,
        d: Tensor,
        options: BundleOptions,
        reduced: "_Reduced",
    ) -> tuple[Tensor, Tensor]:
        information = torch.zeros_like(d)
        residuals = []
        for chunk in _source_chunks(problem.source, options.chunk):
            i, j = problem.source[chunk], problem.target[chunk]
            T_ji = relative_motion(T, i, j)
            p = project(self.grid.camera, self.grid.rays, T_ji, d[i], jacobians=True)
            r = problem.pixels[chunk] - p.pixels
            w = robust_weight(r, problem.weight[chunk] * p.valid[..., None], options.huber)
            residuals.append(_edge_residual(r, w))
            curvature = (w * p.depth_jacobian.square()).sum(-1)
            information.index_add_(0, i, curvature)
            reduced.add(i, j, T_ji, p, r, w, curvature, options.depth_damping)
        return information, torch.cat(residuals) if residuals else d.new_zeros(0)


def _normal_equations(wJ: Tensor, J: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """J^T W J and J^T W r of every edge, summed over its cells."""
    left = wJ.flatten(2)
    right = torch.cat([J.flatten(2), residual.mT.flatten(1)[:, None]], 1)
    both = (left @ right.mT).double()
    return both[..., :6], both[..., 6]


def _edge_residual(residual: Tensor, weight: Tensor) -> Tensor:
    total = weight.sum((1, 2)).clamp(min=1e-12)
    return ((weight * residual.square()).sum((1, 2)) / total * 2).sqrt()


def _source_chunks(source: Tensor, size: int) -> list[slice]:
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


class _Reduced:
    """The camera system left after the inverse depths are eliminated."""

    def __init__(self, problem: BundleProblem, device: torch.device) -> None:
        self.free_depth = problem.free_depth
        count = int(problem.free_pose.sum())
        slot = torch.full((len(problem.T_cw),), -1, dtype=torch.long, device=device)
        slot[problem.free_pose] = torch.arange(count, device=device)
        self.slot, self.frames = slot, len(problem.T_cw)
        self.hessian = torch.zeros(count, count, 6, 6, dtype=torch.float64, device=device)
        self.gradient = torch.zeros(count, 6, dtype=torch.float64, device=device)
        self.stars: list[_Star] = []

    def add(
        self,
        source: Tensor,
        target: Tensor,
        T_ji: Tensor,
        p: Projection,
        residual: Tensor,
        weight: Tensor,
        curvature: Tensor,
        depth_damping: float,
    ) -> None:
        """Add whole stars (all edges of each of their sources)."""
        J, Jd = p.pose_jacobian, p.depth_jacobian
        wJ = J * weight.mT[:, None]
        H, v = _normal_equations(wJ, J, residual)
        coupling = (wJ * Jd.mT[:, None]).sum(2)
        depth_gradient = (weight * Jd * residual).sum(-1)
        adjoint = se3_adjoint(T_ji)
        frames, counts = torch.unique_consecutive(source, return_counts=True)
        start = 0
        for frame, count in zip(frames.tolist(), counts.tolist(), strict=True):
            edges = slice(start, start + count)
            start += count
            block, g = torch.block_diag(*H[edges]), v[edges].reshape(-1)
            if bool(self.free_depth[frame]):
                c = curvature[edges].sum(0)
                c = c + depth_damping * c.mean() + 1e-8
                b = depth_gradient[edges].sum(0)
                e = coupling[edges].reshape(6 * count, -1)
                self.stars.append(_Star(frame, target[edges], adjoint[edges], e, c, b))
                block = block - ((e / c) @ e.mT).double()
                g = g - (e @ (b / c)).double()
            self._scatter(frame, target[edges], adjoint[edges], block, g)

    def _scatter(
        self, frame: int, targets: Tensor, adjoint: Tensor, block: Tensor, gradient: Tensor
    ) -> None:
        """Chain a star's relative system to its poses and add it to the blocks of the free ones."""
        k = len(targets)
        poses = torch.cat([targets, targets.new_tensor([frame])])
        chain = torch.zeros(6 * k, 6 * (k + 1), dtype=torch.float64, device=block.device)
        chain[:, : 6 * k] = torch.eye(6 * k, dtype=torch.float64, device=block.device)
        chain[:, 6 * k :] = -adjoint.reshape(6 * k, 6)
        H = (chain.mT @ block @ chain).reshape(k + 1, 6, k + 1, 6).transpose(1, 2)
        g = (chain.mT @ gradient).reshape(k + 1, 6)
        slot = self.slot[poses]
        keep = slot >= 0
        slot, H, g = slot[keep], H[keep][:, keep], g[keep]
        self.gradient.index_add_(0, slot, g)
        self.hessian.index_put_(
            (slot[:, None].expand(-1, len(slot)), slot[None].expand(len(slot), -1)),
            H,
            accumulate=True,
        )

    def solve(self, damping: float) -> Float[Tensor, "n 6"]:
        """Pose steps of all frames, zero for the fixed ones; NaN if the system cannot be solved."""
        xi = torch.zeros(self.frames, 6, dtype=torch.float64, device=self.gradient.device)
        n = len(self.gradient)
        if not n:
            return xi
        H = self.hessian.transpose(1, 2).reshape(6 * n, 6 * n)
        H = H + torch.diag(damping * H.diagonal().abs() + 1e-2)
        factor, info = torch.linalg.cholesky_ex(H)
        solution = torch.cholesky_solve(self.gradient.reshape(-1, 1), factor)[:, 0]
        if int(info):
            solution = torch.full_like(solution, torch.nan)
        xi[self.slot >= 0] = solution.reshape(n, 6)[self.slot[self.slot >= 0]]
        return xi

    def depth_step(self, xi: Float[Tensor, "n 6"], inverse_depth: Tensor) -> Tensor:
        """Back-substitution: (b - E^T xi_rel) / C for every star."""
        delta = torch.zeros_like(inverse_depth)
        for star in self.stars:
            relative = xi[star.targets] - (star.adjoint @ xi[star.frame])
            moved = star.coupling.mT @ relative.reshape(-1).to(inverse_depth)
            delta[star.frame] = (star.gradient - moved) / star.curvature
        return delta


def solve_poses(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_cw: Float[Tensor, "n 4 4"],
    inverse_depth: Float[Tensor, "e p"],
    T_source: Float[Tensor, "e 4 4"],
    frame: Int[Tensor, "e"],
    pixels: Float[Tensor, "e p 2"],
    weight: Float[Tensor, "e p 2"],
    iterations: int = 4,
    huber: float = 3.0,
) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "e p 2"]]:
    """Motion-only adjustment of independent frames, each seen from keyframes that stay fixed.

    Edge e observes frame ``frame[e]`` from a keyframe at ``T_source[e]`` with the given inverse
    depth. Returns the poses and the residuals of the observations at those poses.
    """
    T = T_cw
    inverse = se3_inverse(T_source)
    for _ in range(iterations):
        p = project(camera, rays, T[frame] @ inverse, inverse_depth, jacobians=True)
        r = pixels - p.pixels
        w = robust_weight(r, weight * p.valid[..., None], huber)
        wJ = p.pose_jacobian * w.mT[:, None]
        H = torch.zeros(len(T), 6, 6, dtype=torch.float64, device=T.device)
        g = torch.zeros(len(T), 6, dtype=torch.float64, device=T.device)
        edge_H, edge_g = _normal_equations(wJ, p.pose_jacobian, r)
        H.index_add_(0, frame, edge_H)
        g.index_add_(0, frame, edge_g)
        damping = 1e-4 * H.diagonal(dim1=-2, dim2=-1) + 1e-6
        xi = torch.linalg.solve(H + torch.diag_embed(damping), g)
        T = move(xi.nan_to_num(0.0, 0.0, 0.0), T)
    final = project(camera, rays, T[frame] @ inverse, inverse_depth)
    return T, pixels - final.pixels
