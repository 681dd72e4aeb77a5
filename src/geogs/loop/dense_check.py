"""Final verification of a loop by dense flow, started from the pose of the features."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.projection import project
from geogs.geometry.lie import scaled, se3_inverse, so3_log
from geogs.loop.verification import DEPTH_TOLERANCE, MAX_SCALE, MIN_CONSISTENT
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.locate.frame_locator import FrameLocator, FrameMotion
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe

MIN_MATCHED = 0.15
"""Least fraction of the cells whose flow agrees with the pose, in each direction."""
MAX_RESIDUAL = 0.0033
"""Largest median reprojection error of the flow, as a fraction of the long edge: under two pixels
of 512."""
MAX_CONTRADICTION = 0.1
"""Largest fraction of one view's surface, within the other's view, that the other sees through. It
rejects similar images of scenes that differ in shape."""
MAX_ROTATION_DISAGREEMENT_DEG = 3.0
"""Largest rotation between the poses estimated in the two directions."""
MIN_NCC = 0.5
"""Least median correlation of the images at those poses, in each direction: different scenes give
0, the same place 0.7 and more."""


@dataclass(frozen=True)
class DenseCheck:
    """Verification of a loop candidate by the flow between its keyframes."""

    accepted: bool
    reason: str
    """Reason for rejection; empty if accepted."""
    T_ji: Float[Tensor, "4 4"] | None = None
    """First camera to second in the first's lengths, float64, by the flow."""
    scale: float = 1.0
    """Lengths of the second's depth per length of the first's."""
    matched: float = 0.0
    """Fraction of the cells whose flow agrees with the pose, in the poorer direction."""
    residual: float = math.inf
    """Median error of the reprojection in pixels, in the poorer direction."""
    contradiction: float = 1.0
    """Fraction of one view's surface that the other sees through, in the poorer direction."""
    there: FlowMatch | None = None
    """Flow from the first to the second, one edge."""
    back: FlowMatch | None = None


def dense_check(
    grid: SampleGrid,
    operator: FlowOperator,
    first: Keyframe,
    second: Keyframe,
    T_ji: Float[Tensor, "4 4"],
    scale: float = 1.0,
) -> DenseCheck:
    """Measure the flow between two keyframes from a candidate relative pose, and verify it.

    Both directions are measured together and located separately, each on the depth of its source.
    Their rotations must agree; both views' depths must agree up to one scale at matches; neither
    may see through the other's surface elsewhere; and the images must pass the photometric check.
    ``T_ji`` is in the first's lengths, ``scale`` as in :class:`DenseCheck`.
    """
    limit = MAX_RESIDUAL * grid.camera.long_edge
    locator = FrameLocator(grid, operator, 0.0, limit, min_ncc=-1.0)
    T_ji = T_ji.to(first.T_cw)
    T_second = T_ji @ first.T_cw
    T_first = se3_inverse(scaled(T_ji, scale)) @ second.T_cw
    there, back = locator.locate_both_ways(first, second, T_second, T_first)
    if there is None or back is None:
        return DenseCheck(False, "the flow agrees with no pose")
    matched = min(there.matched, back.matched)
    residual = max(there.residual, back.residual)
    T_there = there.T_cw @ se3_inverse(first.T_cw)
    T_back = back.T_cw @ se3_inverse(second.T_cw)
    ratios = _depth_ratios(grid, first, second, there, T_there)
    scale_dense, agreeing = _consensus(ratios)
    T_far = se3_inverse(scaled(T_there, scale_dense))
    contradiction = max(
        _seen_through(grid, first, second, T_there, scale_dense),
        _seen_through(grid, second, first, T_far, 1 / scale_dense),
    )
    turn = math.degrees(float(so3_log((T_back @ T_there)[:3, :3]).norm()))
    if matched < MIN_MATCHED:
        reason = f"the flow agrees on only {matched:.0%} of the image"
    elif turn > MAX_ROTATION_DISAGREEMENT_DEG:
        reason = f"the two directions differ by {turn:.1f} degrees"
    elif agreeing < MIN_CONSISTENT:
        reason = f"the depths agree at only {agreeing:.0%} of the matches"
    elif abs(math.log(scale_dense)) > math.log(MAX_SCALE):
        reason = f"the depths differ by a factor of {scale_dense:.2f}"
    elif contradiction > MAX_CONTRADICTION:
        reason = f"one sees through {contradiction:.0%} of what the other shows"
    elif not all(m.check.passes(MIN_NCC, is_expected=False) for m in (there, back)):
        correlation = min(there.check.correlation, back.check.correlation)
        reason = f"the images correlate by only {correlation:.2f}"
    else:
        reason = ""
    return DenseCheck(
        not reason,
        reason,
        T_there,
        scale_dense,
        matched,
        residual,
        contradiction,
        there.match,
        back.match,
    )


def _depth_ratios(
    grid: SampleGrid,
    first: Keyframe,
    second: Keyframe,
    there: FrameMotion,
    T_ji: Float[Tensor, "4 4"],
) -> Float[Tensor, "m"]:
    """Return the log ratio of the second's depth to the first's seen from it, at sure matches."""
    T = T_ji.to(grid.rays)
    pixels = there.match.pixels[0]
    forward = (grid.rays @ T[:3, :3].mT + first.inverse_depth[:, None] * T[:3, 3])[:, 2]
    own = grid.sample_field(second.inverse_depth[:, None], pixels)[:, 0]
    cell, inside = grid.cells_of(pixels)
    good = there.match.sure()[0] & (first.information > 0) & (second.information[cell] > 0)
    good = good & inside & (forward > 1e-6) & (own > 1e-9) & (first.inverse_depth > 1e-9)
    return (first.inverse_depth / (forward * own).clamp(min=1e-12))[good].log()


def _consensus(ratios: Float[Tensor, "m"]) -> tuple[float, float]:
    """Return the median ratio, and the fraction of the ratios that agree with it."""
    if not len(ratios):
        return 1.0, 0.0
    middle = ratios.median()
    return float(middle.exp()), float(((ratios - middle).abs() < DEPTH_TOLERANCE).float().mean())


def _seen_through(
    grid: SampleGrid, source: Keyframe, target: Keyframe, T_ts: Float[Tensor, "4 4"], scale: float
) -> float:
    """Return the fraction of the source's surface that lies before the target's in its view.

    Surface behind the target's is occluded and does not count; 1 where nothing is left.
    """
    T = T_ts.to(grid.rays)
    shown = project(grid.camera, grid.rays, T_ts[None], source.inverse_depth[None])
    pixels = shown.pixels[0]
    forward = (grid.rays @ T[:3, :3].mT + source.inverse_depth[:, None] * T[:3, 3])[:, 2]
    cell, inside = grid.cells_of(pixels)
    known = inside & shown.valid[0] & (forward > 1e-6) & (source.inverse_depth > 1e-9)
    known = known & (source.information > 0) & (target.information[cell] > 0)
    # The nearest of the cells around, so that no edge of a surface counts as a gap in it.
    image = target.inverse_depth.reshape(1, 1, grid.height, grid.width)
    nearest = torch.nn.functional.max_pool2d(image, 3, 1, 1).reshape(-1)[cell]
    expected = (source.inverse_depth / (scale * forward.clamp(min=1e-6))).clamp(min=1e-9)
    ratio = (nearest.clamp(min=1e-9) / expected).log()[known]
    farthest = -torch.nn.functional.max_pool2d(-image, 3, 1, 1).reshape(-1)[cell]
    far_ratio = (farthest.clamp(min=1e-9) / expected)[known].log()
    behind = (ratio < -DEPTH_TOLERANCE).sum()
    same = ((ratio >= -DEPTH_TOLERANCE) & (far_ratio <= DEPTH_TOLERANCE)).sum()
    total = int(behind + same)
    return float(behind) / total if total else 1.0
