"""Which frames become keyframes."""

from geogs.config import TrackingConfig

LEAST_FLOW = 0.2
"""Fraction of the motion that makes a keyframe below which a lost overlap is none: the camera has
hardly moved, so it is the image that is poor."""


def calls_for_keyframe(config: TrackingConfig, long_edge: int, flow: float, overlap: float) -> bool:
    """Whether a frame is far enough from the last keyframe to become one.

    ``flow`` is the median motion of the cells that are matched, in pixels, ``overlap`` the fraction
    of the keyframe's cells that are. In forward motion the cells that move most leave the image
    or are not matched any more, so that the median motion of the rest stays small while the
    overlap goes.
    """
    enough = config.keyframe_flow * long_edge
    if overlap < config.keyframe_overlap:
        enough *= LEAST_FLOW
    return flow >= enough
