"""The specification of one step of dense bundle adjustment: slow, dense, float64, by autograd."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import MIN_Z
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.terms import DepthDamping, MeasuredDepths
from geogs.geometry.camera import Camera
from geogs.geometry.lie import retract, se3_inverse, se3_log


def reproject(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_ji: Float[Tensor, "4 4"],
    inverse_depth: Float[Tensor, "p"],
) -> tuple[Float[Tensor, "p 2"], Tensor]:
    """Pixels in the target of the source's cells, and whether they lie in front of it."""
    points = rays @ T_ji[:3, :3].mT + inverse_depth[:, None] * T_ji[:3, 3]
    pixels, z = camera.project(points)
    return pixels, z > MIN_Z


def residuals(
    problem: BundleProblem, camera: Camera, rays: Tensor, xi: Tensor, delta: Tensor
) -> Float[Tensor, "e p 2"]:
    """Measured minus projected pixels after the steps xi of poses and delta of inverse depths."""
    T = retract(xi, problem.T_cw)
    d = problem.inverse_depth.double() + delta
    rows = []
    for e in range(len(problem.source)):
        i, j = int(problem.source[e]), int(problem.target[e])
        pixels, _ = reproject(camera, rays.double(), T[j] @ se3_inverse(T[i]), d[i])
        rows.append(problem.pixels[e].double() - pixels)
    return torch.stack(rows)


def motion_residuals(problem: BundleProblem, xi: Tensor) -> Float[Tensor, "m 6"]:
    """Residuals of the motions after the steps xi of poses against the measured ones."""
    (m,), T = problem.pose_terms, retract(xi, problem.T_cw)
    return torch.stack([
        se3_log(T[j] @ se3_inverse(T[i]) @ se3_inverse(measured))
        for i, j, measured in zip(m.source.tolist(), m.target.tolist(), m.T_ts, strict=True)
    ])  # fmt: skip


def robust_cost(problem: BundleProblem, camera: Camera, rays: Tensor, huber: float) -> float:
    """Twice what is minimised: rho of every matched cell, number by number.

    rho(s) of a squared residual s in variances is s up to Huber's knee k, then 2 k sqrt(s) - k^2; a
    cell behind its target is 10 k off. Depths that were measured have a knee of 3 deviations, and
    motions Cauchy's loss c^2 log(1 + s / c^2), c = 3.
    """

    def rho(deviations: float, knee: float) -> float:
        if deviations <= knee:
            return deviations**2
        return 2 * knee * deviations - knee**2

    total = 0.0
    T, d = problem.T_cw, problem.inverse_depth.double()
    for e in range(len(problem.source)):
        i, j = int(problem.source[e]), int(problem.target[e])
        at, seen = reproject(camera, rays.double(), T[j] @ se3_inverse(T[i]), d[i])
        for p in range(len(at)):
            if problem.weight[e, p, 0] > 0:
                r = problem.pixels[e, p].double() - at[p]
                off = float((problem.weight[e, p].double() * r * r).sum()) ** 0.5
                total += rho(off if seen[p] else 10 * huber, huber)
    for term in problem.depth_terms:
        if isinstance(term, MeasuredDepths):
            off = term.information.double().sqrt() * (term.inverse_depth.double() - d).abs()
            total += sum(rho(x, 3.0) for x in off.reshape(-1).tolist())
    if problem.pose_terms:
        e = motion_residuals(problem, torch.zeros(len(T), 6, dtype=torch.float64))
        square = (problem.pose_terms[0].information * e * e).sum(-1)
        total += sum(9 * math.log(1 + s / 9) for s in square.tolist())
    return total


def gauss_newton_step(
    problem: BundleProblem, camera: Camera, rays: Float[Tensor, "p 3"], options: BundleOptions
) -> tuple[Float[Tensor, "n 6"], Float[Tensor, "n p"]]:
    """The step of the free poses and inverse depths from the full normal equations.

    Minimises sum w rho(r) with Huber's weights at the present state, sum a rho(measured - d) of
    inverse depths that were measured, and Cauchy's loss of motions that were. The same damping as
    the fast solver: of inverse depth in the full system, of poses in the system without depths.
    """
    n, p = problem.inverse_depth.shape
    xi = torch.zeros(n, 6, dtype=torch.float64)
    delta = torch.zeros(n, p, dtype=torch.float64)
    r = residuals(problem, camera, rays, xi, delta)
    w = problem.weight.double()
    norm = (w * r * r).sum(-1, keepdim=True).sqrt()
    w = w * (options.huber / norm.clamp(min=options.huber))
    Jx, Jd = torch.func.jacrev(
        lambda a, b: residuals(problem, camera, rays, a, b).reshape(-1), (0, 1)
    )(xi, delta)
    Jx, Jd, w, r = -Jx.reshape(-1, 6 * n), -Jd.reshape(-1, n * p), w.reshape(-1), r.reshape(-1)
    pose = problem.free_pose.repeat_interleave(6)
    depth = problem.free_depth.repeat_interleave(p)
    Jx, Jd = Jx[:, pose], Jd[:, depth]
    C = (Jd.mT @ (w[:, None] * Jd)).diagonal()
    mean = C.reshape(-1, p).mean(1).repeat_interleave(p)
    C = C + options.depth_damping * mean + 1e-8
    pull = torch.zeros_like(delta)
    for term in problem.depth_terms:
        if isinstance(term, DepthDamping):
            C = C + term.curvature.double().reshape(-1)[depth]
            continue
        assert isinstance(term, MeasuredDepths)
        away = term.inverse_depth.double() - problem.inverse_depth.double()
        a = term.information.double()
        a = a * (3.0 / (a.sqrt() * away.abs()).clamp(min=3.0))
        C = C + a.reshape(-1)[depth]
        pull = pull + a * away
    C = torch.diag(C)
    H, E = Jx.mT @ (w[:, None] * Jx), Jx.mT @ (w[:, None] * Jd)
    v, b = Jx.mT @ (w * r), Jd.mT @ (w * r) + pull.reshape(-1)[depth]
    if problem.pose_terms:
        e = motion_residuals(problem, xi)
        Jm = torch.func.jacrev(lambda a: motion_residuals(problem, a).reshape(-1))(xi)
        Jm = Jm.reshape(-1, 6 * n)[:, pose]
        a = problem.pose_terms[0].information
        a = a / (1 + (a * e * e).sum(-1, keepdim=True) / 3.0**2)
        H = H + Jm.mT @ (a.reshape(-1, 1) * Jm)
        v = v - Jm.mT @ (a * e).reshape(-1)
    S = H - E @ torch.linalg.inv(C) @ E.mT
    H = H + torch.diag(options.damping * S.diagonal().abs() + 1e-2)
    step = torch.linalg.solve(
        torch.cat([torch.cat([H, E], 1), torch.cat([E.mT, C], 1)]), torch.cat([v, b])
    )
    xi = xi.reshape(-1).masked_scatter(pose, step[: len(v)]).reshape(n, 6)
    delta = delta.reshape(-1).masked_scatter(depth, step[len(v) :]).reshape(n, p)
    return xi, delta
