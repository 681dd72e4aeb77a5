"""Every setting, as a tree of frozen dataclasses; it is saved with each result.

The string under a field is its help text: meaning, unit, range.
"""

from geogs.config.input_config import InputConfig
from geogs.config.loss_config import LossAblation, LossConfig
from geogs.config.mapping_config import (
    DepthConfig,
    DiskConfig,
    MapAblation,
    MappingConfig,
    PhotoConfig,
)
from geogs.config.mesh_config import MeshConfig
from geogs.config.prior_config import DepthSensorConfig, OdometryConfig, PriorConfig
from geogs.config.reconstruct_config import (
    ReconstructConfig,
    SearchConfig,
    known_pose_mapping,
    reconstruct_preset,
)
from geogs.config.run_config import Config, Preset, Seed, preset, preset_of
from geogs.config.tracking_config import CalibrationConfig, LoopConfig, TrackingConfig

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
    "preset_of",
    "reconstruct_preset",
]
