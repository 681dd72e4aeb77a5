"""The chance that a pixel's depth is right."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32

from geogs.depth.evidence import TrackerEvidence
from geogs.depth.refinement import SlantedDepth


class ConfidenceWeights(NamedTuple):
    """Weights of a logistic regression of "relative depth error below 2 %" on the evidence of
    ``depth_confidence``, and the struct of this name in ``cuda/refinement.cu``.

    Fitted to two rendered rooms at once; fitted to one room they predict the other as well.
    """

    bias: float = -0.55
    margin: float = 0.41
    tracker_agrees: float = 0.75
    tracker_differs: float = -0.75
    jump: float = -0.43
    support: float = 0.48
    tolerance: float = 0.02
    """Relative depth error that still counts as right."""


WEIGHTS = ConfidenceWeights()


def depth_confidence(
    refined: SlantedDepth, margin: Float32[np.ndarray, "h w"], tracker: TrackerEvidence
) -> Float32[np.ndarray, "h w"]:
    """Chance that each depth is right to 2 %.

    Evidence: the margin of the sweep's winner; whether the tracker, where it is confident, agrees
    with the refined inverse depth; depth jumps to the next pixels; the support of the last plane
    fit.
    """
    w = WEIGHTS
    depth = 1.0 / refined.inverse_depth
    kernel = np.ones((3, 3), np.uint8)
    jump = np.log(cv2.dilate(depth, kernel) / cv2.erode(depth, kernel)) / w.tolerance
    known = np.minimum(tracker.precision * np.float32(w.tolerance**2), 1.0)
    agrees = np.exp(-0.5 * ((tracker.inverse_depth * depth - 1.0) / 0.03) ** 2)
    score = w.bias + w.margin * np.clip(margin, 0.0, 4.0)
    score += known * (w.tracker_agrees * agrees + w.tracker_differs * (1.0 - agrees))
    score += w.jump * np.minimum(jump, 5.0) + w.support * np.log(refined.support + 0.1)
    return (1.0 / (1.0 + np.exp(-score))).astype(np.float32)
