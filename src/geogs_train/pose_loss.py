"""What poses and depths that came out of a bundle adjustment are judged by.

The losses of Teed and Deng, "DROID-SLAM", NeurIPS 2021, section 3.3: geodesic distance of relative
poses, flow that poses and depths induce, and what the adjustment left over; each over all updates
of an unrolled network, the later ones counting more.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.lie import se3_inverse, se3_log
from geogs_train.bundle import ClipCameras, ClipEdges, ClipState, relative_motions, reproject


@dataclass(frozen=True)
class PoseLossOptions:
    """Weights of the terms; the defaults are DROID-SLAM's."""

    decay: float = 0.9
    """Weight of an update relative to the one after it."""
    pose: float = 10.0
    flow: float = 0.4
    """Where positions are in cells of 8 pixels; DROID-SLAM's 0.05 is for pixels."""
    residual: float = 0.01


@dataclass(frozen=True)
class Estimate:
    """Poses and depths after an update, and what its measurements still disagreed by."""

    state: ClipState
    residual: Float[Tensor, "b e p 2"]
    """Measured minus reprojected position, zero behind cameras."""


@dataclass(frozen=True)
class PoseErrors:
    """Means over a batch, each a scalar."""

    pose: Tensor
    """Sum of distance and angle of relative poses, map units plus radians."""
    flow: Tensor
    """Distance of induced positions."""
    residual: Tensor
    """Absolute residual of a coordinate."""


def geodesic_errors(
    found: Float[Tensor, "b v 4 4"],
    truth: Float[Tensor, "b v 4 4"],
    edges: ClipEdges,
) -> tuple[Float[Tensor, "b e"], Float[Tensor, "b e"]]:
    """Translation and rotation of log(found_ji truth_ji^-1) of every edge, units and radians."""
    a, b = relative_motions(found, edges), relative_motions(truth.to(found), edges)
    xi = se3_log(a @ se3_inverse(b))
    return xi[..., :3].norm(dim=-1), xi[..., 3:].norm(dim=-1)


def induced_flow_error(
    cameras: ClipCameras, found: ClipState, truth: ClipState, edges: ClipEdges
) -> tuple[Float[Tensor, "b e p"], Float[Tensor, "b e p"]]:
    """Distance of where two states project the same cells, and 1 where both can."""
    a, b = reproject(cameras, found, edges), reproject(cameras, truth, edges)
    valid = (a.valid & b.valid).to(a.pixels)
    return (a.pixels - b.pixels).norm(dim=-1) * valid, valid


def pose_errors(
    cameras: ClipCameras,
    estimate: Estimate,
    truth: ClipState,
    edges: ClipEdges,
) -> PoseErrors:
    """The terms of one update, without their weights."""
    shift, angle = geodesic_errors(estimate.state.T_cw, truth.T_cw, edges)
    flow, valid = induced_flow_error(cameras, estimate.state, truth, edges)
    return PoseErrors(
        shift.mean() + angle.mean(),
        flow.sum() / valid.sum().clamp(min=1),
        estimate.residual.abs().mean(),
    )


def pose_loss(
    cameras: ClipCameras,
    estimates: Sequence[Estimate],
    truth: ClipState,
    edges: ClipEdges,
    options: PoseLossOptions | None = None,
) -> tuple[Tensor, list[PoseErrors]]:
    """The loss of all updates, first to last, and the errors of each."""
    options = options or PoseLossOptions()
    errors = [pose_errors(cameras, e, truth, edges) for e in estimates]
    terms = [
        options.decay**age
        * (options.pose * e.pose + options.flow * e.flow + options.residual * e.residual)
        for age, e in enumerate(reversed(errors))
    ]
    return torch.stack(terms).sum(), errors
