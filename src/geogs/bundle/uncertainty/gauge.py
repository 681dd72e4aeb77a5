"""Uncertainty of poses with a free gauge: independent of the choice of world frame and unit."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.lie import se3_inverse, so3_hat

RANK = 1e-9
"""Relative effect on the cameras below which a direction of the alignment is ignored: cameras on a
line can be rotated about it freely, cameras at one position only translated."""


class PoseDeviations(NamedTuple):
    """Standard deviations of poses, all axes together."""

    position: Float[Tensor, "n"]
    """Deviation of each camera's centre, in the unit of the poses."""
    rotation: Float[Tensor, "n"]
    """Deviation of each orientation, radians."""


def deviations_after_alignment(
    T_cw: Float[Tensor, "n 4 4"], covariance: Float[Tensor, "m m"]
) -> PoseDeviations:
    """Compute deviations of poses after removing the similarity that fits their errors best.

    A trajectory is compared in this way with the truth, which has its own frame and unit. The
    result does not depend on the pose and the length that were fixed for the covariance.

    Args:
        T_cw: world to camera, float64.
        covariance: of the left perturbations (translation, then rotation) of all poses, m = 6n;
            where it is not finite, deviations are infinite.

    To first order, a perturbation moves a centre c by -R^T tau, and alignment removes from the
    shifts of all centres their projection on those of a Sim(3), (I, -[c]x, c); from the rotations
    in the world, -R^T phi, their mean, as the best-fitting rotation does.
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
    """Return the deviation of each three numbers after removing the projection on J's columns."""
    if not bool(covariance.isfinite().all()):
        return covariance.new_full((len(covariance) // 3,), torch.inf)
    Q, strength, _ = torch.linalg.svd(J, full_matrices=False)
    Q = Q[:, strength > RANK * strength.max()]
    rest = covariance - Q @ (Q.mT @ covariance)
    variance = rest.diagonal() - ((rest @ Q) * Q).sum(1)
    return variance.reshape(-1, 3).sum(1).clamp(min=0).sqrt()
