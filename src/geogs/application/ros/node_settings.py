"""Settings of the node."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from geogs.config import Config, preset
from geogs.config.setting import Basic, Positive, Settings, Unnamed


@dataclass(frozen=True)
class NodeSettings(Settings):
    """Track a camera in ROS 2: publishes ~/pose, ~/path, ~/cloud and ~/mesh until Ctrl-C.

    Needs rclpy, which comes with an installation of ROS 2 (source its setup file first).
    """

    image: str = "/camera/image_raw"
    """Topic of the images: sensor_msgs/msg/Image or CompressedImage, by the end of its name."""
    info: str = "/camera/camera_info"
    """Topic of their camera, sensor_msgs/msg/CameraInfo; images before it are left out."""
    frame_id: str = "map"
    """Name of the map's frame of reference."""
    every: Positive = 2.0
    """Seconds between two clouds, and at least between two meshes."""
    mesh: bool = False
    """Publish the mesh, too, which takes the longer the larger the map is."""
    output: Annotated[Path | None, Basic("-o")] = None
    """Folder for the map at the end; none keeps nothing."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda or cuda:1."""
    config: Annotated[Config, Unnamed()] = field(default_factory=lambda: preset("fast"))
