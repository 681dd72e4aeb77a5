"""The node of ROS 2, without ROS: its messages by rosbags' types, its way with a stand-in."""

import sys
from dataclasses import MISSING, fields
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from geogs.application.ros.node import CameraNode, Messages, run_node
from geogs.application.ros.node_settings import NodeSettings
from geogs.errors import InputError
from geogs.mesh.triangle_mesh import Mesh
from geogs.types import MapSnapshot

typesys = pytest.importorskip(
    "rosbags.typesys", reason="messages need rosbags (pip install 'geogs[ros]')"
)
STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
_PLAIN = {"int": 0, "float": 0.0, "bool": False, "str": ""}


def make(kind: str, **given: Any) -> Any:
    """A message of rosbags; what is not given is as ROS has it."""
    cls = STORE.types[kind]
    for field in fields(cls):
        if field.name not in given and field.default is MISSING:
            given[field.name] = default(str(field.type))
    return cls(**given)


def default(annotation: str) -> Any:
    if annotation in _PLAIN:
        return _PLAIN[annotation]
    if annotation.startswith("list"):
        return []
    if "ndarray" in annotation:
        return np.zeros(0, np.uint8)
    return make(annotation.replace("__", "/"))


def round_trip(kind: str, message: Any) -> Any:
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, kind), kind)


MESSAGES = Messages(make, "world")


def test_poses_and_paths_are_camera_to_world():
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    T[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    pose = MESSAGES.pose(12.5, T)
    path = round_trip("nav_msgs/msg/Path", MESSAGES.path(13.0, [pose, pose]))
    assert (path.header.frame_id, path.header.stamp.sec, len(path.poses)) == ("world", 13, 2)
    found = path.poses[1]
    assert (found.header.stamp.sec, found.header.stamp.nanosec) == (12, 500_000_000)
    q = found.pose.orientation
    assert [q.x, q.y, q.z, q.w] == pytest.approx([0, 0, 0.5**0.5, 0.5**0.5])
    p = found.pose.position
    assert (p.x, p.y, p.z) == (1, 2, 3)
    late = MESSAGES.header(1.9999999999)
    assert (late.stamp.sec, late.stamp.nanosec) == (1, 999_999_999)


def test_clouds_have_places_and_normals():
    g = torch.Generator().manual_seed(0)
    position = torch.rand(5, 3, generator=g)
    quaternion = torch.tensor([[1.0, 0, 0, 0]]).expand(5, 4)
    disks = MapSnapshot(position, quaternion, torch.ones(5, 2), torch.ones(5))
    cloud = round_trip("sensor_msgs/msg/PointCloud2", MESSAGES.cloud(0.0, disks))
    assert (cloud.width, cloud.height, cloud.point_step, cloud.row_step) == (5, 1, 24, 120)
    assert [f.name for f in cloud.fields][:4] == ["x", "y", "z", "normal_x"]
    rows = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(5, 6)
    np.testing.assert_array_equal(rows[:, :3], position.numpy())
    np.testing.assert_array_equal(rows[:, 3:], np.tile([0, 0, 1], (5, 1)))


def test_meshes_are_lists_of_triangles():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    mesh = Mesh.from_triangles(vertices, np.array([[0, 1, 2], [0, 3, 1]], np.int32))
    marker = round_trip("visualization_msgs/msg/Marker", MESSAGES.mesh(1.0, mesh))
    assert (marker.type, marker.action, len(marker.points)) == (11, 0, 6)
    assert [marker.points[4].x, marker.points[4].y, marker.points[4].z] == [0, 0, 1]
    assert marker.pose.orientation.w == marker.scale.x == marker.color.a == 1


def test_without_ros_there_is_a_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(InputError, match="needs rclpy"):
        run_node(NodeSettings())


class Topics:
    """In place of a node of ROS."""

    def __init__(self) -> None:
        self.heard: dict[str, Any] = {}
        self.said: dict[str, list[Any]] = {}

    def create_subscription(self, kind, topic, callback, depth):
        self.heard[topic] = callback

    def create_publisher(self, kind, topic, depth):
        said = self.said.setdefault(topic, [])
        return SimpleNamespace(publish=said.append)


class Tracked:
    """In place of the system: a camera that moves to the right."""

    frames = 0

    def __init__(self, camera, config, device, live, pinhole) -> None:
        assert live
        assert camera == pinhole

    def process(self, image, seconds):
        self.frames += 1
        T_wc = torch.eye(4, dtype=torch.float64)
        T_wc[0, 3] = self.frames
        return SimpleNamespace(T_wc=None if self.frames == 1 else T_wc)

    def snapshot(self):
        return MapSnapshot(
            torch.zeros(2, 3), torch.tensor([[1.0, 0, 0, 0]] * 2), torch.ones(2, 2), torch.ones(2)
        )


def test_the_node_publishes_what_it_tracks(monkeypatch):
    for package in ("sensor_msgs", "geometry_msgs", "nav_msgs", "visualization_msgs"):
        module = ModuleType(f"{package}.msg")
        module.__getattr__ = lambda name: name  # a name stands for the class
        monkeypatch.setitem(sys.modules, f"{package}.msg", module)
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
    monkeypatch.setattr("geogs.application.ros.node.message_of", make)
    monkeypatch.setattr("geogs.application.ros.node.Slam", Tracked)
    topics = Topics()
    node = CameraNode(topics, NodeSettings(image="/cam/image_raw", every=1e-6))
    pixels = np.full((48, 64, 3), 90, np.uint8)
    image = make(
        "sensor_msgs/msg/Image", header=MESSAGES.header(3.0), height=48, width=64, encoding="rgb8",
        is_bigendian=0, step=192, data=pixels.reshape(-1),
    )  # fmt: skip
    hear = topics.heard["/cam/image_raw"]
    hear(image)  # before the camera is known
    topics.heard["/camera/camera_info"](
        make(
            "sensor_msgs/msg/CameraInfo", height=48, width=64, distortion_model="plumb_bob",
            d=np.zeros(5), k=np.array([50.0, 0, 31.5, 0, 50, 23.5, 0, 0, 1]), r=np.eye(3).ravel(),
            p=np.zeros(12),
        )
    )  # fmt: skip
    for _ in range(3):
        hear(image)
    assert [p.pose.position.x for p in topics.said["~/pose"]] == [2, 3]
    assert [len(p.poses) for p in topics.said["~/path"]] == [1, 2]
    assert [c.width for c in topics.said["~/cloud"]] == [2, 2, 2]
    assert topics.said["~/mesh"] == []
    node.finish()
