"""The sizes that mapping works at."""

from dataclasses import dataclass

from geogs.config import MappingConfig
from geogs.geometry.camera import Camera


@dataclass(frozen=True)
class MapCameras:
    """One camera at the three sizes that mapping works with."""

    working: Camera
    """Of the images as the tracker sees them."""
    render: Camera
    """Of the rendered maps and keyframe depths."""
    photo: Camera
    """Of the images that L_mv compares."""

    @staticmethod
    def of(camera: Camera, config: MappingConfig) -> "MapCameras":
        """The sizes that the settings ask for, none above the working image."""
        working = max(camera.width, camera.height)
        long_edge = min(config.render_long_edge, working)
        photo = min(round(config.photo_scale * long_edge), working)
        return MapCameras(camera, camera.with_long_edge(long_edge), camera.with_long_edge(photo))
