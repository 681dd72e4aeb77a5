"""Messages of ROS 2 that the node publishes; nothing here needs ROS.

Axes are those of the map: x right, y down, z forward of the first camera. Lengths are the map's.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from geogs.geometry.lie import matrix_to_quaternion
from geogs.mesh.triangle_mesh import Mesh
from geogs.types import MapSnapshot

Make = Callable[..., Any]
"""Makes a message of a type, such as ``geometry_msgs/msg/Point``, from its fields by name; others
have ROS's defaults."""

FLOAT32, TRIANGLE_LIST = 7, 11
"""Numbers of ``sensor_msgs/msg/PointField`` and ``visualization_msgs/msg/Marker``."""
_CLOUD_FIELDS = ("x", "y", "z", "normal_x", "normal_y", "normal_z")


@dataclass(frozen=True)
class Messages:
    """Builds messages in one frame of reference."""

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
            "sensor_msgs/msg/PointCloud2", header=self.header(seconds), height=1, width=len(rows),
            fields=fields, is_bigendian=False, point_step=step, row_step=step * len(rows),
            data=rows.view(np.uint8).reshape(-1), is_dense=True,
        )  # fmt: skip

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
            "visualization_msgs/msg/Marker", header=self.header(seconds), ns="geogs", id=0,
            type=TRIANGLE_LIST, action=0, pose=pose, color=grey,
            scale=self.make("geometry_msgs/msg/Vector3", **one),
            points=[self.point(corner) for corner in corners],
        )  # fmt: skip

    def point(self, xyz: Sequence[float]) -> Any:
        """Make a ``geometry_msgs/msg/Point``."""
        x, y, z = xyz
        return self.make("geometry_msgs/msg/Point", x=x, y=y, z=z)
