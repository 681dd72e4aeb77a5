"""Small recordings of ROS for the tests, by the writers of ``rosbags``."""

from pathlib import Path
from typing import Self

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
START, STEP = 1_000_000_000_000, 50_000_000
"""Nanoseconds."""
_FROM_RGB = {"bgr8": cv2.COLOR_RGB2BGR, "bgra8": cv2.COLOR_RGB2BGRA, "mono8": cv2.COLOR_RGB2GRAY}


class BagWriter:
    """A bag of one kind: ``bag`` of ROS 1, ``sqlite`` or ``mcap`` of ROS 2."""

    def __init__(self, folder: Path, kind: str) -> None:
        self._is_1 = kind == "bag"
        self.path = folder / ("one.bag" if self._is_1 else kind)
        plugins = {"sqlite": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}
        self._writer = (
            Writer1(self.path)
            if self._is_1
            else Writer2(self.path, version=9, storage_plugin=plugins[kind])
        )
        self._store = get_typestore(Stores.ROS1_NOETIC if self._is_1 else Stores.ROS2_HUMBLE)
        self._connections: dict[str, object] = {}

    def __enter__(self) -> Self:
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def image(self, topic, k, image, encoding="rgb8", padding=0, is_stamped=True) -> None:
        """An RGB image as message ``k``; one of a single channel as it is."""
        if image.ndim == 3:
            if encoding == "mono16":
                grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.uint16)
                image = (grey * 256 + 7).view(np.uint8)
            elif encoding in _FROM_RGB:
                image = cv2.cvtColor(image, _FROM_RGB[encoding])
        self._raw(topic, k, image, encoding, padding, is_stamped)

    def rows(self, topic, k, rows, encoding, height=48, is_bigendian=0) -> None:
        """The rows of an image as bytes, in any encoding of 64 columns."""
        self._raw(topic, k, rows, encoding, 0, True, None, height, is_bigendian)

    def depth(self, topic, k, depth) -> None:
        """A depth image in millimetres."""
        self._raw(topic, k, depth.view(np.uint8), "16UC1", 0, True, depth.shape)

    def _raw(
        self, topic, k, pixels, encoding, padding, is_stamped, shape=None, height=None, big=0
    ) -> None:
        width = 64
        rows = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, padding)), constant_values=99)
        message = self._store.types[IMAGE](
            header=self._header(k if is_stamped else None),
            height=height or len(pixels), width=width, encoding=encoding, is_bigendian=big,
            step=rows.shape[1],
            data=np.ascontiguousarray(rows).reshape(-1),
        )  # fmt: skip
        self._write(topic, IMAGE, k, message)

    def compressed(self, topic, k, image, form, damaged=False) -> None:
        """An RGB image compressed as ``png`` or ``jpeg``."""
        _, data = cv2.imencode(f".{form}", image[..., ::-1])
        data = data.reshape(-1)[: 40 if damaged else None]
        message = self._store.types[COMPRESSED](
            header=self._header(k), format=f"bgr8; {form} compressed bgr8", data=data
        )
        self._write(topic, COMPRESSED, k, message)
        self._last = message

    def image_at(self, topic, k) -> None:
        """The compressed image before, once more and somewhat later."""
        self._write(topic, COMPRESSED, k + 0.5, self._last)

    def camera_info(
        self, topic, k, distortion=(), model="plumb_bob", size=(64, 48), roi=(0, 0, 0, 0), binning=1
    ) -> None:
        """A camera of f = 50, 51 in the middle of 64 x 48 pixels; 40, 41 at 30.5 rectified."""
        scale = size[0] / 64
        fx, fy = 50 * scale, 51 * scale
        cx, cy = (size[0] - 1) / 2, (size[1] - 1) / 2
        names = "DKRP" if self._is_1 else "dkrp"
        numbers = (
            distortion,
            (fx, 0, cx, 0, fy, cy, 0, 0, 1),
            np.eye(3).reshape(-1),
            (40, 0, 30.5, 0, 0, 41, 22.5, 0, 0, 0, 1, 0),
        )
        x, y, width, height = roi
        message = self._store.types[INFO](
            header=self._header(k), height=size[1], width=size[0], distortion_model=model,
            binning_x=binning, binning_y=binning,
            roi=self._store.types["sensor_msgs/msg/RegionOfInterest"](
                x_offset=x, y_offset=y, height=height, width=width, do_rectify=False
            ),
            **{n: np.array(v, np.float64) for n, v in zip(names, numbers, strict=True)},
        )  # fmt: skip
        self._write(topic, INFO, k, message)

    def _header(self, k):
        nanoseconds = 0 if k is None else START + k * STEP
        stamp = self._store.types["builtin_interfaces/msg/Time"](
            sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9
        )
        more = {"seq": 0} if self._is_1 else {}
        return self._store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera", **more)

    def broken(self, topic, k) -> None:
        """A message of a compressed image that ends too early."""
        self._connect(topic, COMPRESSED)
        self._writer.write(self._connections[topic], int(START + k * STEP), bytes(6))

    def _write(self, topic, kind, k, message) -> None:
        self._connect(topic, kind)
        serialize = self._store.serialize_ros1 if self._is_1 else self._store.serialize_cdr
        self._writer.write(
            self._connections[topic], int(START + k * STEP), serialize(message, kind)
        )

    def _connect(self, topic, kind) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._store
            )
