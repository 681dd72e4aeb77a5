"""The specification of a lens and of one step of its adjustment: slow, dense, float64, autograd."""

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.problem import BundleProblem
from geogs.geometry.camera import Camera
from geogs.geometry.lie import retract, se3_inverse


def reproject(
    camera: Camera,
    pixels: Float[Tensor, "p 2"],
    unknowns: Float[Tensor, "3"],
    T_ji: Float[Tensor, "4 4"],
    inverse_depth: Float[Tensor, "p"],
) -> Float[Tensor, "p 2"]:
    """Pixels of one frame in another, for log of the factor on the focal length, k1 and k2."""

    def bent(x: Float[Tensor, "p 2"]) -> Float[Tensor, "p 1"]:
        square = x.square().sum(-1, keepdim=True)
        return 1 + unknowns[1] * square + unknowns[2] * square.square()

    centre = torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    focal = torch.tensor([camera.fx, camera.fy], dtype=torch.float64) * unknowns[0].exp()
    distorted = (pixels.double() - centre) / focal
    x = distorted
    for _ in range(40):  # a fixed point; autograd goes through all of it
        x = distorted / bent(x)
    rays = torch.cat([x, torch.ones_like(x[:, :1])], -1)
    y = rays @ T_ji[:3, :3].mT + inverse_depth[:, None] * T_ji[:3, 3]
    y = y[:, :2] / y[:, 2:]
    return y * bent(y) * focal + centre


def residuals(
    problem: BundleProblem,
    camera: Camera,
    pixels: Float[Tensor, "p 2"],
    xi: Float[Tensor, "n 6"],
    unknowns: Float[Tensor, "3"],
    delta: Float[Tensor, "n p"],
) -> Float[Tensor, "e p 2"]:
    """Measured minus projected pixels after steps of poses and inverse depths."""
    T, d = retract(xi, problem.T_cw), problem.inverse_depth.double() + delta
    rows = []
    for e, (i, j) in enumerate(zip(problem.source.tolist(), problem.target.tolist(), strict=True)):
        at = reproject(camera, pixels, unknowns, T[j] @ se3_inverse(T[i]), d[i])
        rows.append(problem.pixels[e].double() - at)
    return torch.stack(rows)


def gauss_newton_step(
    problem: BundleProblem,
    camera: Camera,
    pixels: Float[Tensor, "p 2"],
    distortion: tuple[float, float],
    huber: float,
    depth_damping: float,
) -> tuple[Float[Tensor, "n 6"], Float[Tensor, "3"], Float[Tensor, "n p"]]:
    """Steps of poses (the first is fixed), lens and inverse depths from the full equations.

    The scale, which is not determined, is that of the least step (pseudo-inverse of the poses'
    and the lens's system, the depths eliminated).
    """
    n, p = problem.inverse_depth.shape
    xi = torch.zeros(n, 6, dtype=torch.float64)
    lens = torch.tensor([0.0, *distortion], dtype=torch.float64)
    delta = torch.zeros(n, p, dtype=torch.float64)
    r = residuals(problem, camera, pixels, xi, lens, delta)
    w = problem.weight.double()
    norm = (w * r * r).sum(-1, keepdim=True).sqrt()
    w = (w * (huber / norm.clamp(min=huber))).reshape(-1, 1)
    J = torch.func.jacfwd(
        lambda a, b, c: residuals(problem, camera, pixels, a, b, c).reshape(-1), (0, 1, 2)
    )(xi, lens, delta)
    Jx = torch.cat([-J[0].reshape(-1, 6 * n)[:, 6:], -J[1]], 1)
    Jd, b = -J[2].reshape(-1, n * p), r.reshape(-1, 1)
    C = (w * Jd * Jd).sum(0)
    C = C + depth_damping * C.reshape(n, p).mean(1).repeat_interleave(p) + 1e-8
    E, v, u = Jx.mT @ (w * Jd), Jx.mT @ (w * b), Jd.mT @ (w * b)
    S = Jx.mT @ (w * Jx) - (E / C) @ E.mT
    step = torch.linalg.pinv(S, hermitian=True, rtol=1e-9) @ (v - E @ (u / C[:, None]))
    depth = (u - E.mT @ step)[:, 0] / C
    xi[1:] = step[:-3].reshape(n - 1, 6)
    return xi, step[-3:, 0], depth.reshape(n, p)
