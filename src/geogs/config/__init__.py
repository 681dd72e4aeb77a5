"""Every setting, as a tree of frozen dataclasses; it is saved with each result.

The string under a field is its help text: meaning, unit, range.
"""

from geogs.config.input import InputConfig
from geogs.config.losses import LossAblation, LossConfig
from geogs.config.mapping import DepthConfig, DiskConfig, MapAblation, MappingConfig, PhotoConfig
from geogs.config.mesh import MeshConfig
from geogs.config.priors import DepthSensorConfig, OdometryConfig, PriorConfig
from geogs.config.reconstruct import (
    ReconstructConfig,
    SearchConfig,
    known_pose_mapping,
    reconstruct_preset,
)
from geogs.config.run import Config, Preset, Seed, preset
from geogs.config.tracking import CalibrationConfig, LoopConfig, TrackingConfig

__all__ = [
    "CalibrationConfig",
    "Config",
    "DepthConfig",
    "DepthSensorConfig",
    "DiskConfig",
    "InputConfig",
    "LoopConfig",
    "LossAblation",
    "LossConfig",
    "MapAblation",
    "MappingConfig",
    "MeshConfig",
    "OdometryConfig",
    "PhotoConfig",
    "Preset",
    "PriorConfig",
    "ReconstructConfig",
    "SearchConfig",
    "Seed",
    "TrackingConfig",
    "known_pose_mapping",
    "preset",
    "reconstruct_preset",
]
