"""How likely a pixel's depth is right, from what its making has seen."""

import cv2
import numpy as np
from jaxtyping import Float32

from geogs.depth.evidence import DepthEvidence
from geogs.depth.refinement import SlantedDepth

# Weights of a logistic regression of "relative depth error below 2 %" on the evidence below,
# fitted to two rendered rooms at once; fitted to one room they predict the other as well.
_BIAS = -0.55
_MARGIN = 0.41
_TRACKER_AGREES = 0.75
_TRACKER_DIFFERS = -0.75
_JUMP = -0.43
_SUPPORT = 0.48

_TOLERANCE = 0.02
"""Relative depth error that still counts as right."""

WEIGHTS = (_BIAS, _MARGIN, _TRACKER_AGREES, _TRACKER_DIFFERS, _JUMP, _SUPPORT, _TOLERANCE)
"""All of them, for the CUDA kernel."""


def depth_confidence(
    refined: SlantedDepth,
    margin: Float32[np.ndarray, "h w"],
    tracker: DepthEvidence,
) -> Float32[np.ndarray, "h w"]:
    """Chance that each depth is right to 2 %.

    Evidence: the margin of the sweep's winner; whether the tracker, where it is sure, agrees with
    the refined inverse depth; depth jumps to the next pixels;
    the support of the last plane fit.
    """
    depth = 1.0 / refined.inverse_depth
    kernel = np.ones((3, 3), np.uint8)
    jump = np.log(cv2.dilate(depth, kernel) / cv2.erode(depth, kernel)) / _TOLERANCE
    known = np.minimum(tracker.weight * np.float32(_TOLERANCE**2), 1.0)
    agrees = np.exp(-0.5 * ((tracker.inverse_depth * depth - 1.0) / 0.03) ** 2)
    score = _BIAS + _MARGIN * np.clip(margin, 0.0, 4.0)
    score += known * (_TRACKER_AGREES * agrees + _TRACKER_DIFFERS * (1.0 - agrees))
    score += _JUMP * np.minimum(jump, 5.0) + _SUPPORT * np.log(refined.support + 0.1)
    return (1.0 / (1.0 + np.exp(-score))).astype(np.float32)
