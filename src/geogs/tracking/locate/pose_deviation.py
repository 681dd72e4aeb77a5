"""Standard deviations of a frame's pose, from the matches that located it."""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.projection import linearise
from geogs.bundle.uncertainty.marginals import ALIKE
from geogs.geometry.lie import se3_inverse
from geogs.tracking.frames.pose_filling import depth_aware_weight
from geogs.tracking.locate.frame_locator import FrameMotion
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe

DeviationOf = Callable[[], "PoseDeviation"]
"""Function that computes a deviation; it takes a considerable part of a frame's time."""


@dataclass(frozen=True)
class PoseDeviation:
    """Standard deviations of a pose relative to the keyframe it was located at."""

    position: float
    """Deviation of the camera centre, all axes together, map units; infinite where unknown."""
    rotation: float
    """Deviation of the camera's orientation, radians."""


def pose_deviation(
    grid: SampleGrid, keyframe: Keyframe, T_rel: Float[Tensor, "4 4"], match: FlowMatch
) -> PoseDeviation:
    """Return the deviations of a frame's pose at ``T_rel`` from a keyframe, by the edge between.

    The inverse of sum J^T W J over the cells, J the derivative of a cell's position by a left
    perturbation of the pose, and 1 / W the variance of its match plus that due to its depth; times
    ``ALIKE``, as errors of neighbours are correlated.
    """
    p = linearise(grid.camera, grid.rays, T_rel[None].to(grid.device), keyframe.inverse_depth[None])
    known = keyframe.confident_information[None]
    weight = depth_aware_weight(match.weight[:1], p.depth_jacobian, known) * p.valid[..., None]
    J = p.pose_jacobian[0]
    return left_open(torch.einsum("icp,jcp,pc->ij", J, J, weight[0]).double().cpu())


def left_open(H: Float[Tensor, "6 6"]) -> PoseDeviation:
    """Return the deviations of a pose from normal equations of its left perturbation; float64, CPU.

    Infinite where these are singular.
    """
    scale = H.diagonal().clamp(min=1e-30).rsqrt()
    inverse, failed = torch.linalg.inv_ex(scale[:, None] * H * scale)
    if int(failed):
        return PoseDeviation(torch.inf, torch.inf)
    squares = ALIKE * (inverse.diagonal() * scale.square()).reshape(2, 3).sum(-1)
    position, rotation = squares.clamp(min=0).sqrt().tolist()
    return PoseDeviation(position, rotation)


def deviation_of(grid: SampleGrid, keyframe: Keyframe, motion: FrameMotion) -> DeviationOf:
    """Return a function that computes :func:`pose_deviation` later from the present state."""
    T_rel = motion.T_cw @ se3_inverse(keyframe.T_cw).to(motion.T_cw)
    return partial(pose_deviation, grid, copy(keyframe), T_rel, motion.match)
