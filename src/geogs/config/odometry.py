"""Settings of poses beside the images: how far their relative motion is believed."""

from dataclasses import dataclass

from geogs.config.setting import Positive, Settings, Share


@dataclass(frozen=True)
class OdometryConfig(Settings, group="odometry"):
    """The noise of measured motions between keyframes, where ``input.poses`` uses them.

    The deviation along each axis of a motion by s metres is the root of ``deviation^2 +
    (drift s)^2``.
    """

    deviation: Positive = 0.003
    """Metres by which a position may be off from one keyframe to the next, however near."""
    drift: Share = 0.01
    """Fraction of the distance that is wrong besides."""
