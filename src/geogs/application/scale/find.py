"""The scale of a map by whatever is known in metres."""

from geogs.application.scale.distance import scale_by_distances
from geogs.application.scale.ground import scale_by_height
from geogs.application.scale.scene import FoundScale, MeasurableScene
from geogs.application.scale.source import (
    CameraHeight,
    KnownDistances,
    ScaleSource,
    SensorScale,
    TagSize,
)
from geogs.application.scale.tags import scale_by_tags
from geogs.errors import InputError
from geogs.io.sources.calibration import Calibration


def find_scale(scene: MeasurableScene, source: ScaleSource, calibration: Calibration) -> FoundScale:
    """Metres to the map unit. Raises InputError where the scene does not tell."""
    match source:
        case KnownDistances():
            return scale_by_distances(scene, source, calibration)
        case TagSize():
            return scale_by_tags(scene, source)
        case CameraHeight():
            return scale_by_height(scene, source)
        case SensorScale():
            raise InputError("--scale-from sensor needs measured depth: give --depth sensor.")
