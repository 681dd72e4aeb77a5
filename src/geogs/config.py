"""Every setting, as one tree of frozen dataclasses; it is saved with each result.

The string under a field is its help text: meaning, unit, range.
"""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class InputConfig:
    """How the source is read."""

    intrinsics: str = "auto"
    """auto, a file, or fx,fy,cx,cy[,k1,k2,p1,p2[,k3]] in pixels of the source image."""
    long_edge: int = 512
    """Longer side of the working image in pixels; smaller sources are not enlarged."""
    start: int = 0
    """First frame of the source."""
    stop: int | None = None
    """Frame of the source before which to stop; none reads to the end."""
    stride: int = 1
    """Use every stride-th frame, at least 1."""


@dataclass(frozen=True)
class TrackingConfig:
    """Motion filter, frame graph and dense bundle adjustment."""


@dataclass(frozen=True)
class DepthConfig:
    """Dense depth of a keyframe before any disk is made."""


@dataclass(frozen=True)
class LossConfig:
    """Weights and thresholds of the mapping losses."""


@dataclass(frozen=True)
class MappingConfig:
    """The disk map and its training."""

    depth: DepthConfig = field(default_factory=DepthConfig)
    loss: LossConfig = field(default_factory=LossConfig)


@dataclass(frozen=True)
class MeshConfig:
    """Surface extraction."""


@dataclass(frozen=True)
class Config:
    """All settings of a run."""

    seed: int = 0
    """Random seed; same seed, same machine, same result on the CPU."""
    input: InputConfig = field(default_factory=InputConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)
