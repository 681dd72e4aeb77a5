"""Distances of matches from the epipolar geometry of their pairs, and how they change with it.

Each pair of views has its own rotation and direction of translation (an essential matrix, five
numbers); all share one camera. The distance is Sampson's, in pixels: to first order how far the two
points of a match have to move until they obey the geometry.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.geometry.lie import so3_exp, so3_hat


@dataclass(frozen=True)
class MatchedPairs:
    """Matches of pairs of views, in square pixels from the principal point."""

    first: Float64[Tensor, "k n 2"]
    second: Float64[Tensor, "k n 2"]
    weight: Float64[Tensor, "k n"]
    """1; 0 of what fills up the pairs that have fewer matches."""


@dataclass(frozen=True)
class EpipolarState:
    """The geometry of all pairs, and the logarithm of their focal length in pixels."""

    R: Float64[Tensor, "k 3 3"]
    """First camera to second."""
    t: Float64[Tensor, "k 3"]
    """The same, of unit length."""
    log_focal: Float64[Tensor, ""]

    def moved(self, step: Float[Tensor, "k 5"], log_focal: Float[Tensor, ""]) -> "EpipolarState":
        """With each pair's rotation changed by three numbers and its translation by two, along
        tangents, and with the logarithm of the focal length changed."""
        axis = torch.eye(3, dtype=self.t.dtype)[self.t.abs().argmin(1)]
        u = torch.nn.functional.normalize(torch.linalg.cross(self.t, axis), dim=1)
        v = torch.linalg.cross(self.t, u)
        t = torch.nn.functional.normalize(self.t + step[:, 3:4] * u + step[:, 4:] * v, dim=1)
        return EpipolarState(so3_exp(step[:, :3]) @ self.R, t, self.log_focal + log_focal)


def errors(
    pairs: MatchedPairs, state: EpipolarState, k1: Float[Tensor, ""] | float = 0.0
) -> Float[Tensor, "k n"]:
    """Sampson's distance of each match, pixels; with a sign.

    ``k1`` is of a lens that takes a ray of tangent r to r (1 + k1 r^2), and is inverted to first
    order.
    """
    focal = state.log_focal.exp()
    x, y = (_rays(p / focal, k1) for p in (pairs.first, pairs.second))
    E = so3_hat(state.t) @ state.R
    line, back = x @ E.mT, y @ E
    length = (line[..., :2].square().sum(-1) + back[..., :2].square().sum(-1)).clamp(min=1e-18)
    return focal * (y * line).sum(-1) / length.sqrt()


def linearised(
    pairs: MatchedPairs, state: EpipolarState
) -> tuple[Float64[Tensor, "k n"], Float64[Tensor, "k n 7"]]:
    """The distances, and how they change with the pair's five numbers, log focal, and k1 at 0."""

    def at(step: Tensor) -> tuple[Tensor, Tensor]:
        found = errors(pairs, state.moved(step[:5].expand(len(state.t), 5), step[5]), step[6])
        return found, found

    J, error = torch.func.jacfwd(at, has_aux=True)(torch.zeros(7, dtype=torch.float64))
    return error, J


def _rays(p: Float[Tensor, "k n 2"], k1: Float[Tensor, ""] | float) -> Float[Tensor, "k n 3"]:
    return torch.nn.functional.pad(
        p * (1 - k1 * p.square().sum(-1, keepdim=True)), (0, 1), value=1.0
    )
