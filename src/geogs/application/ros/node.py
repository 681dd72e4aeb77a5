"""The node: images in, pose, path, cloud and mesh out. ``rclpy`` is imported when it runs."""

import importlib
import logging
import math
import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from geogs.application.ros.node_settings import NodeSettings
from geogs.application.slam_in_python import save_slam, slam_mesh
from geogs.errors import InputError
from geogs.geometry.lie import matrix_to_quaternion
from geogs.io.sources.ros.recorded_messages import calibration_of, picture_of
from geogs.io.sources.undistort import Rectifier
from geogs.mesh.triangle_mesh import Mesh
from geogs.slam import Slam
from geogs.types import MapSnapshot

Make = Callable[..., Any]
"""Makes a message of a type, such as ``geometry_msgs/msg/Point``, from its fields by name; others
have ROS's defaults."""

FLOAT32, TRIANGLE_LIST = 7, 11
"""Numbers of ``sensor_msgs/msg/PointField`` and ``visualization_msgs/msg/Marker``."""
_CLOUD_FIELDS = ("x", "y", "z", "normal_x", "normal_y", "normal_z")


@dataclass(frozen=True)
class Messages:
    """Builds messages in one frame of reference: that of the map, x right, y down, z forward."""

    make: Make
    frame_id: str = "map"
    """Name of the map's frame."""

    def header(self, seconds: float) -> Any:
        """Make a ``std_msgs/msg/Header``."""
        whole = math.floor(seconds)
        nanoseconds = min(round((seconds - whole) * 1e9), 999_999_999)
        stamp = self.make("builtin_interfaces/msg/Time", sec=whole, nanosec=nanoseconds)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=self.frame_id)

    def pose(self, seconds: float, T_wc: Float64[Tensor, "4 4"]) -> Any:
        """Make a ``geometry_msgs/msg/PoseStamped`` of a camera."""
        w, x, y, z = matrix_to_quaternion(T_wc[:3, :3]).tolist()
        rotation = self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        place = self.point(T_wc[:3, 3].tolist())
        pose = self.make("geometry_msgs/msg/Pose", position=place, orientation=rotation)
        return self.make("geometry_msgs/msg/PoseStamped", header=self.header(seconds), pose=pose)

    def path(self, seconds: float, poses: Sequence[Any]) -> Any:
        """Make a ``nav_msgs/msg/Path`` of poses made by :meth:`pose`."""
        return self.make("nav_msgs/msg/Path", header=self.header(seconds), poses=list(poses))

    def cloud(self, seconds: float, disks: MapSnapshot) -> Any:
        """Make a ``sensor_msgs/msg/PointCloud2`` of the disks' centres and normals."""
        rows = torch.cat([disks.position, disks.normal], 1).float().cpu().numpy()
        rows = np.ascontiguousarray(rows, dtype="<f4")
        fields = [
            self.make(
                "sensor_msgs/msg/PointField", name=name, offset=4 * n, datatype=FLOAT32, count=1
            )
            for n, name in enumerate(_CLOUD_FIELDS)
        ]
        step = 4 * len(fields)
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(seconds),
            height=1,
            width=len(rows),
            fields=fields,
            is_bigendian=False,
            point_step=step,
            row_step=step * len(rows),
            data=rows.view(np.uint8).reshape(-1),
            is_dense=True,
        )

    def mesh(self, seconds: float, mesh: Mesh) -> Any:
        """Make a ``visualization_msgs/msg/Marker``: a list of triangles, grey."""
        corners = mesh.vertices[mesh.faces].reshape(-1, 3).tolist()
        one = {"x": 1.0, "y": 1.0, "z": 1.0}
        grey = self.make("std_msgs/msg/ColorRGBA", r=0.7, g=0.7, b=0.7, a=1.0)
        upright = self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        pose = self.make(
            "geometry_msgs/msg/Pose", position=self.point([0.0, 0.0, 0.0]), orientation=upright
        )
        return self.make(
            "visualization_msgs/msg/Marker",
            header=self.header(seconds),
            ns="geogs",
            id=0,
            type=TRIANGLE_LIST,
            action=0,
            pose=pose,
            color=grey,
            scale=self.make("geometry_msgs/msg/Vector3", **one),
            points=[self.point(corner) for corner in corners],
        )

    def point(self, xyz: Sequence[float]) -> Any:
        """Make a ``geometry_msgs/msg/Point``."""
        x, y, z = xyz
        return self.make("geometry_msgs/msg/Point", x=x, y=y, z=z)


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
            "pose": ("geometry_msgs", "PoseStamped"),
            "path": ("nav_msgs", "Path"),
            "cloud": ("sensor_msgs", "PointCloud2"),
            "mesh": ("visualization_msgs", "Marker"),
        }
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
        self._rectifier = Rectifier(
            calibration, config.input.long_edge, config.input.working_field_of_view, keeps_lens=True
        )
        cameras = self._rectifier.image_camera, self._rectifier.camera
        self._slam = Slam(cameras[0], config, self._settings.device, live=True, pinhole=cameras[1])

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
