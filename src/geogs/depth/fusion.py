"""The check of a keyframe's depth by those of other keyframes."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from geogs.depth.carve import look_up
from geogs.depth.depth_view import KeyframeDepth
from geogs.depth.reprojection_kernels import agree_on_depth, splat_depth
from geogs.geometry.camera import Camera

BIAS, OWN, SUPPORT, VIOLATION = -0.10, 0.66, 0.72, -0.92
"""Coefficients of a logistic regression of "relative error below 2 %", as in ``depth_confidence``,
on the confidence and the others' votes."""
SPLAT_CONFIDENCE = 0.5
"""Confidence from which pixels of other keyframes repair this one."""

AVERAGE_REACH = 0.01
"""Relative distance within which depths of several keyframes are averaged."""
AGREEMENT_REACH = 0.015
"""Relative distance within which another keyframe's depth supports a pixel."""
VIOLATION_DISTANCE = 0.05
"""Relative distance in front of another keyframe's depth beyond which a pixel violates it."""
REPAIR_BELOW = 0.4
"""Confidence below which a pixel takes the depth that others agree on."""
REPAIR_VOTES = 1.0
"""Sum of the others' confidences needed for that, so that more than one agrees."""
REPAIR_CONFIDENCE = 0.3
"""Confidence of such a pixel before the others' votes are counted."""
OCCLUSION_PENALTY = 0.7
"""Weight of a transferred depth that hides a candidate, against one that agrees with it."""


def check_depth(
    depth: KeyframeDepth,
    T_cw: Float64[np.ndarray, "4 4"],
    others: Sequence[KeyframeDepth],
    other_poses: Sequence[Float64[np.ndarray, "4 4"]],
    camera: Camera,
) -> KeyframeDepth:
    """Repair, average and rate a keyframe's depth by those of other keyframes.

    Pixels of low confidence on whose depth several others agree take it. Then each pixel's point is
    looked up in the other views: surfaces within ``AVERAGE_REACH`` (relative, Gaussian) are
    averaged by confidence; those near support the pixel; confident ones that are clearly behind the
    point violate it, since they see free space at its position. To be called once per estimate:
    votes counted twice raise the confidence too far.
    """
    T_wc = np.linalg.inv(T_cw)
    depth = _repair(depth, T_wc, others, other_poses, camera)
    points = depth.depth.reshape(-1, 1) * camera.rays().numpy().reshape(-1, 3)
    shift, votes, support, violation = (np.zeros(len(points), np.float32) for _ in range(4))
    for other, pose in zip(others, other_poses, strict=True):
        ratio, confidence = look_up(points, pose @ T_wc, other, camera)
        error = ratio - np.float32(1.0)
        near = confidence * np.exp(-0.5 * (error / np.float32(AVERAGE_REACH)) ** 2)
        shift += near * error
        votes += near
        support += confidence * np.exp(-0.5 * (error / np.float32(AGREEMENT_REACH)) ** 2)
        violation += confidence * (error < -VIOLATION_DISTANCE)
    shape = depth.depth.shape
    averaged = depth.depth / (1.0 + shift / (votes + np.float32(0.5))).reshape(shape)
    own = np.clip(depth.confidence, 1e-3, 1.0 - 1e-3)
    score = BIAS + OWN * np.log(own / (1.0 - own))
    score += (SUPPORT * np.log(support + 0.2) + VIOLATION * violation).reshape(shape)
    return KeyframeDepth(averaged, (1.0 / (1.0 + np.exp(-score))).astype(np.float32))


def _repair(
    depth: KeyframeDepth,
    T_wc: Float64[np.ndarray, "4 4"],
    others: Sequence[KeyframeDepth],
    other_poses: Sequence[Float64[np.ndarray, "4 4"]],
    camera: Camera,
) -> KeyframeDepth:
    """The depth with pixels of low confidence replaced by confident ones of other views."""
    shape = (len(others), *depth.depth.shape)
    seen = np.zeros(shape, np.float32)
    weight = np.zeros(shape, np.float32)
    rays = camera.rays().numpy().reshape(-1, 3)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    least = np.float32(SPLAT_CONFIDENCE)
    for j, (other, pose) in enumerate(zip(others, other_poses, strict=True)):
        relative = np.linalg.inv(pose @ T_wc).astype(np.float32)
        points = other.depth.reshape(-1, 1) * rays
        confidence = other.confidence.ravel()
        rotation = np.ascontiguousarray(relative[:3, :3])
        translation = np.ascontiguousarray(relative[:3, 3])
        splat_depth(points, confidence, rotation, translation, lens, least, seen[j], weight[j])
    best = np.empty_like(depth.depth)
    score = np.empty_like(depth.depth)
    reach = np.float32(AGREEMENT_REACH)
    clearance = np.float32(VIOLATION_DISTANCE)
    uncertain = depth.confidence < REPAIR_BELOW
    penalty = np.float32(OCCLUSION_PENALTY)
    agree_on_depth(seen, weight, uncertain, reach, clearance, penalty, best, score)
    taken = uncertain & (score > REPAIR_VOTES)
    confidence = np.where(taken, np.float32(REPAIR_CONFIDENCE), depth.confidence)
    return KeyframeDepth(np.where(taken, best, depth.depth), confidence)
