"""What poses and depths that came out of a bundle adjustment are judged by.

The losses of Teed and Deng, "DROID-SLAM", NeurIPS 2021, section 3.3: geodesic distance of relative
poses and flow that poses and depths induce, both over all updates of an unrolled network, the later
ones counting more.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.lie import se3_inverse, se3_log
from geogs_train.flow.bundle import ClipCameras, ClipEdges, ClipState, relative_motions, reproject


@dataclass(frozen=True)
class PoseLossOptions:
    """Weights of the terms; the defaults are DROID-SLAM's."""

    decay: float = 0.9
    """Weight of an update relative to the one after it."""
    pose: float = 10.0
    flow: float = 0.4
    """Where positions are in cells of 8 pixels; DROID-SLAM's 0.05 is for pixels."""


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


def pose_loss(
    cameras: ClipCameras,
    found: Sequence[ClipState],
    truth: ClipState,
    edges: ClipEdges,
    options: PoseLossOptions | None = None,
) -> Float[Tensor, ""]:
    """The loss of the poses and depths after each update, first to last."""
    options = options or PoseLossOptions()
    terms = []
    for age, state in enumerate(reversed(found)):
        shift, angle = geodesic_errors(state.T_cw, truth.T_cw, edges)
        distance, valid = induced_flow_error(cameras, state, truth, edges)
        pose = shift.mean() + angle.mean()
        flow = distance.sum() / valid.sum().clamp(min=1)
        terms.append(options.decay**age * (options.pose * pose + options.flow * flow))
    return torch.stack(terms).sum()
