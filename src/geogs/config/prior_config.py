"""Settings of what is known beside the images: measured depth, measured poses, and priors."""

from dataclasses import dataclass
from typing import Annotated

from geogs.config.setting import Basic, Fraction, NamesFile, Positive, Range, Settings


@dataclass(frozen=True)
class DepthSensorConfig(Settings, group="sensor"):
    """The noise of measured depth, where ``input.depth`` uses it.

    The deviation of an inverse depth d is the root of ``deviation^2 + (ratio d)^2 + (g / 2)^2``
    with the change g of inverse depth from pixel to pixel.
    """

    deviation: Positive = 0.0015
    """Deviation of an inverse depth, per metre: what grows with the square of depth, such as 1.5 mm
    at 1 m and 24 mm at 4 m, as structured light and stereo have it."""
    ratio: Fraction = 0.005
    """Fraction of the depth that is wrong in common: calibration, temperature."""


@dataclass(frozen=True)
class OdometryConfig(Settings, group="odometry"):
    """The noise of measured motions between keyframes, where ``input.poses`` uses them.

    The deviation along each axis of a motion by s metres is the root of ``deviation^2 +
    (drift s)^2``, that of its rotation about each axis of ``0.15^2 + (rotation_drift s)^2``.
    """

    deviation: Positive = 0.003
    """Metres by which a position may be off from one keyframe to the next, however near."""
    drift: Fraction = 0.01
    """Fraction of the distance that is wrong besides."""
    rotation_drift: Annotated[float, Range(0, 90)] = 0.3
    """Degrees by which an orientation may be off with each metre."""


@dataclass(frozen=True)
class PriorConfig(Settings, group="prior"):
    """Depth and normals that a network guesses from single keyframes; without a model, none."""

    model: Annotated[str, NamesFile(), Basic()] = ""
    """Network for depth (or depth and normals): a file; none does without."""
    card: Annotated[str, NamesFile()] = ""
    """Card of its input and output: the name of one that comes with geogs, or a YAML file."""
    normal_model: Annotated[str, NamesFile()] = ""
    """Another network for normals, where the first has none: a file."""
    normal_card: Annotated[str, NamesFile()] = ""
    """Card of that network."""
    scale_rows: Annotated[int, Range(2, 64)] = 8
    """Nodes of the scale field from top to bottom."""
    scale_columns: Annotated[int, Range(2, 64)] = 10
    """Nodes from left to right. HI-SLAM2 has 2 by 2, with no bound on their difference."""
    scale_step: Positive = 0.1
    """Relative difference that is usual between neighbouring nodes."""
    reject: bool = True
    """Leave out what contradicts the matches, cells and whole keyframes, and trust the rest by how
    well it agrees; off trusts every prior everywhere alike, as HI-SLAM2 does."""
