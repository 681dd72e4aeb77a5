"""How well an adjustment knows its poses and inverse depths: marginal variances at its solution.

With the reduced camera system S of all stars (depths eliminated) and the factor e of an inverse
depth in the coupling, ``var d = 1/c + e^T S^-1 e / c^2``: what its own matches leave open, and what
the poses do. Source: the block inverse; Rosinol et al. 2023 use it for dense bundle adjustment.

Matches of neighbouring cells err alike, and so do those of one cell along several edges, so that
the information of the sum is less than the sum of the information: the caller says by how much.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.base import BundleOptions
from geogs.bundle.linearise import Star, linearise_stars
from geogs.bundle.problem import BundleProblem
from geogs.geometry.lie import se3_inverse
from geogs.keyframes.grid import SampleGrid


@dataclass(frozen=True)
class Marginals:
    """Variances of the free unknowns of a problem, in units and radians; the rest are zero."""

    pose: Float[Tensor, "n 6 6"]
    """Covariance of the left perturbation of each pose; float64, on the CPU."""
    inverse_depth: Float[Tensor, "n p"]
    """Variance; infinite where no match tells of the depth, or where the poses are open."""

    def relative_depth(
        self, inverse_depth: Float[Tensor, "n p"], information: Float[Tensor, "n p"]
    ) -> Float[Tensor, "n"]:
        """Median of sigma_d / d over the measured cells of each frame; infinite without any."""
        sigma = self.inverse_depth.sqrt() / inverse_depth.abs().clamp(min=1e-12)
        sigma = torch.where(information > 0, sigma, torch.nan)
        return sigma.nanmedian(-1).values.nan_to_num(torch.inf)


def marginals(
    grid: SampleGrid,
    problem: BundleProblem,
    options: BundleOptions | None = None,
    inflation: float = 1.0,
) -> Marginals:
    """Marginal variances at the present state of a problem, the matches taken as its weights say.

    ``inflation`` multiplies the variance of every match: the noise beyond what weights say, and
    how many matches err as one. Where only one pose is fixed the scale is held by the distances
    from that camera, so that depths are those relative to the length of the path.
    """
    options = options or BundleOptions()
    stars = linearise_stars(grid, problem, problem.T_cw, problem.inverse_depth, options)
    covariance = inflation * _pose_covariance(problem, stars)
    n = len(problem.T_cw)
    pose = torch.stack([covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(n)])
    depth = torch.zeros_like(problem.inverse_depth)
    for star in stars:
        if star.depth is not None:
            depth[star.frame] = _depth_variance(star, covariance, inflation)
    free = problem.free_depth.to(depth.device)[:, None]
    measured = torch.zeros(n, dtype=torch.bool)
    measured[[star.frame for star in stars]] = True
    known = measured.to(depth.device)[:, None]
    return Marginals(pose, torch.where(free & ~known, torch.inf, depth))


def _pose_covariance(problem: BundleProblem, stars: list[Star]) -> Float[Tensor, "m m"]:
    """Inverse of the reduced camera system over all poses, zero for the fixed ones."""
    n = len(problem.T_cw)
    H = torch.zeros(6 * n, 6 * n, dtype=torch.float64)
    for star in stars:
        rows = _rows(star.poses.cpu())
        H[rows[:, None], rows] += star.chained()[0].cpu()
    if int((~problem.free_pose).sum()) <= 1:
        H += _held_scale(problem.T_cw.double().cpu(), problem.free_pose.cpu(), H)
    free = torch.nonzero(problem.free_pose.cpu().repeat_interleave(6))[:, 0]
    S = H[free[:, None], free]
    # What no match tells of is open, not an error: its variance becomes very large.
    S = S + 1e-9 * torch.diag(S.diagonal().abs() + 1e-6)
    covariance = torch.zeros_like(H)
    factor, failed = torch.linalg.cholesky_ex(S)
    open_ = torch.full_like(S, torch.inf)
    covariance[free[:, None], free] = open_ if int(failed) else torch.cholesky_inverse(factor)
    return covariance


def _held_scale(
    T_cw: Float[Tensor, "n 4 4"], free_pose: Tensor, H: Float[Tensor, "m m"]
) -> Float[Tensor, "m m"]:
    """A stiff spring along the direction in which all distances from the fixed camera grow."""
    fixed = torch.nonzero(~free_pose)[:, 0]
    centre = se3_inverse(T_cw[int(fixed[0]) if len(fixed) else 0])[:3, 3]
    away = T_cw[:, :3, :3] @ centre + T_cw[:, :3, 3]
    along = torch.cat([away, torch.zeros_like(away)], 1).reshape(-1)
    along = along / along.norm().clamp(min=1e-12)
    return 1e3 * H.diagonal().max() * along[:, None] * along


def _depth_variance(
    star: Star, covariance: Float[Tensor, "m m"], inflation: float
) -> Float[Tensor, "p"]:
    """Of the inverse depths of a star, from its own curvature and the covariance of its poses."""
    depth = star.depth
    assert depth is not None
    rows = _rows(star.poses.cpu())
    E = star.chain.mT.to(depth.coupling) @ depth.coupling
    among = covariance[rows[:, None], rows].to(E)
    through_poses = (E * (among @ E)).sum(0) / depth.curvature.square()
    own = inflation / depth.curvature
    return torch.where(star.information > 0, own + through_poses, torch.inf)


def _rows(poses: Int[Tensor, "k"]) -> Int[Tensor, "c"]:
    return (6 * poses[:, None] + torch.arange(6)).reshape(-1)
