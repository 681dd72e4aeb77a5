"""Uncertainty of poses whose gauge is free: what no choice of world frame and unit takes away."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.lie import se3_inverse, so3_hat

RANK = 1e-9
"""Directions of the alignment that move the cameras by less than this part of the strongest are
none: cameras on a line are turned about it freely, those at one place only moved."""


class PoseDeviations(NamedTuple):
    """Standard deviations of poses, all axes together."""

    position: Float[Tensor, "n"]
    """Deviation of each camera's centre, in the unit of the poses."""
    rotation: Float[Tensor, "n"]
    """Deviation of each orientation, radians."""


def deviations_after_alignment(
    T_cw: Float[Tensor, "n 4 4"], covariance: Float[Tensor, "m m"]
) -> PoseDeviations:
    """Deviations of poses once the similarity is taken out that fits their errors best.

    That is how a trajectory is compared with the truth, which has a frame and a unit of its own.
    Whatever pose was fixed for the covariance, and whatever length, the answer is the same.

    Args:
        T_cw: world to camera, float64.
        covariance: of the left perturbations (translation, then rotation) of all poses, m = 6n;
            where it is not finite, nothing is known.

    To first order, a perturbation moves a centre c by -R^T tau, and alignment takes from the moves
    of all centres their projection on those of a Sim(3), (I, -[c]x, c); from the turns in the
    world, -R^T phi, their mean, as the rotation that fits the orientations best does.
    """
    n, R_wc = len(T_cw), T_cw[:, :3, :3].mT
    both = covariance.reshape(n, 2, 3, n, 2, 3)
    moves, turns = (
        torch.einsum("iab,ibjc,jdc->iajd", R_wc, both[:, k, :, :, k], R_wc).reshape(3 * n, 3 * n)
        for k in (0, 1)
    )
    centres = se3_inverse(T_cw)[:, :3, 3]
    centres = centres - centres.mean(0)
    eye = torch.eye(3).to(T_cw).expand(n, 3, 3)
    similarity = torch.cat([eye, -so3_hat(centres), centres[..., None]], 2).reshape(3 * n, 7)
    return PoseDeviations(_left_over(moves, similarity), _left_over(turns, eye.reshape(3 * n, 3)))


def _left_over(covariance: Float[Tensor, "m m"], J: Float[Tensor, "m k"]) -> Float[Tensor, "n"]:
    """Deviation of each three numbers after the projection on the columns of J is taken out."""
    if not bool(covariance.isfinite().all()):
        return covariance.new_full((len(covariance) // 3,), torch.inf)
    Q, strength, _ = torch.linalg.svd(J, full_matrices=False)
    Q = Q[:, strength > RANK * strength.max()]
    rest = covariance - Q @ (Q.mT @ covariance)
    variance = rest.diagonal() - ((rest @ Q) * Q).sum(1)
    return variance.reshape(-1, 3).sum(1).clamp(min=0).sqrt()
