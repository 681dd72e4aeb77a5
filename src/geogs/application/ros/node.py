"""The node: images in, pose, path, cloud and mesh out. ``rclpy`` is imported when it runs."""

import importlib
import logging
import time
from array import array
from typing import Any

import numpy as np
import torch

from geogs.application.ros.node_settings import NodeSettings
from geogs.application.ros.published_messages import Messages
from geogs.application.slam_in_python import save_slam, slam_mesh
from geogs.errors import InputError
from geogs.io.sources.ros.recorded_messages import calibration_of, picture_of
from geogs.io.sources.undistort import Rectifier
from geogs.slam import Slam

_log = logging.getLogger(__name__)
MAX_POSES = 10_000
"""Largest number of poses in the published path; the latest are kept."""


def run_node(settings: NodeSettings) -> None:
    """Track until the node is shut down, then save the map if ``output`` is given.

    Raises:
        InputError: there is no ROS 2.
        OutputError: the map cannot be written.
    """
    try:
        rclpy = importlib.import_module("rclpy")
    except ImportError:
        raise InputError(
            "geogs ros2 needs rclpy, which comes with an installation of ROS 2: source its setup "
            "file first. Recordings are read without it: geogs run recording.mcap."
        ) from None
    rclpy.init(args=[])
    node = rclpy.create_node("geogs")
    tracker = CameraNode(node, settings)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        if rclpy.ok():
            rclpy.shutdown()
    tracker.finish()


def message_of(kind: str, **fields: Any) -> Any:
    """Make a ROS 2 message of a kind such as ``geometry_msgs/msg/Point``."""
    package, _, name = kind.split("/")
    message = getattr(importlib.import_module(f"{package}.msg"), name)()
    for field, value in fields.items():
        is_bytes = isinstance(value, np.ndarray)
        setattr(message, field, array("B", value.tobytes()) if is_bytes else value)
    return message


class CameraNode:
    """Subscribes to a camera and publishes pose, path, cloud and mesh."""

    def __init__(self, node: Any, settings: NodeSettings) -> None:
        self._settings = settings
        self._messages = Messages(message_of, settings.frame_id)
        self._slam: Slam | None = None
        self._rectifier: Rectifier | None = None
        self._poses: list[Any] = []
        self._shown = time.monotonic()
        self._size = (0, 0)
        compressed = settings.image.rsplit("/", 1)[-1] == "compressed"
        image = _type("sensor_msgs", "CompressedImage" if compressed else "Image")
        node.create_subscription(_type("sensor_msgs", "CameraInfo"), settings.info, self.info, 1)
        # One image waits at most: ROS drops images that come faster than they are tracked.
        node.create_subscription(image, settings.image, self.image, 1)
        kinds = {
            "pose": ("geometry_msgs", "PoseStamped"), "path": ("nav_msgs", "Path"),
            "cloud": ("sensor_msgs", "PointCloud2"), "mesh": ("visualization_msgs", "Marker"),
        }  # fmt: skip
        self._publish = {
            name: node.create_publisher(_type(*kind), f"~/{name}", 1).publish
            for name, kind in kinds.items()
        }

    def info(self, message: Any) -> None:
        """Take the camera parameters, once."""
        if self._slam is not None:
            return
        is_rectified = self._settings.image.rsplit("/", 1)[-1].startswith("image_rect")
        found = calibration_of(message, self._settings.info, is_rectified)
        if found is None:
            _log.warning("%s says nothing of the camera.", self._settings.info)
            return
        self._size = (int(message.width), int(message.height))
        config = self._settings.config
        calibration = found.fit(*self._size)
        self._rectifier = Rectifier(calibration, config.input.long_edge, config.input.field_of_view)
        self._slam = Slam(self._rectifier.camera, config, self._settings.device, live=True)

    def image(self, message: Any) -> None:
        """Track an image and publish its pose."""
        picture = picture_of(message).picture
        if self._slam is None or self._rectifier is None or picture is None:
            return
        if (picture.shape[1], picture.shape[0]) != self._size:
            _log.warning("An image of another size than its camera's is left out.")
            return
        stamp = message.header.stamp
        seconds = stamp.sec + 1e-9 * stamp.nanosec
        try:
            found = self._slam.process(self._rectifier(picture), seconds)
        except InputError as why:  # a time that does not increase
            _log.warning("%s", why)
            return
        if found.T_wc is not None:
            pose = self._messages.pose(seconds, torch.as_tensor(found.T_wc))
            self._poses = [*self._poses, pose][-MAX_POSES:]
            self._publish["pose"](pose)
            self._publish["path"](self._messages.path(seconds, self._poses))
        if time.monotonic() - self._shown >= self._settings.every:
            self._show(seconds)
            self._shown = time.monotonic()

    def _show(self, seconds: float) -> None:
        slam = self._slam
        assert slam is not None
        self._publish["cloud"](self._messages.cloud(seconds, slam.snapshot()))
        mesh = slam_mesh(slam) if self._settings.mesh else None
        if mesh is not None:
            self._publish["mesh"](self._messages.mesh(seconds, mesh))

    def finish(self) -> None:
        """Save the map, if an output folder is given and there is a map."""
        if self._slam is None or self._settings.output is None or not self._slam.frames:
            return
        self._slam.finish()
        save_slam(self._slam, self._settings.output)


def _type(package: str, name: str) -> Any:
    return getattr(importlib.import_module(f"{package}.msg"), name)
