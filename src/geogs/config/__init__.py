"""Every setting, as a tree of frozen dataclasses; it is saved with each result.

The string under a field is its help text: meaning, unit, range.
"""

from geogs.config.calibration import CalibrationConfig
from geogs.config.depth import DepthConfig
from geogs.config.input import InputConfig
from geogs.config.known_poses import (
    ReconstructConfig,
    SearchConfig,
    known_pose_mapping,
    reconstruct_preset,
)
from geogs.config.loop import LoopConfig
from geogs.config.losses import LossAblation, LossConfig
from geogs.config.mapping import DiskConfig, MapAblation, MappingConfig, PhotoConfig
from geogs.config.mesh import MeshConfig
from geogs.config.odometry import OdometryConfig
from geogs.config.prior import PriorConfig
from geogs.config.sensor import DepthSensorConfig
from geogs.config.slam import Config, Preset, Seed, preset
from geogs.config.tracking import TrackingConfig

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
