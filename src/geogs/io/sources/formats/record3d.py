"""A recording of Record3D: an ``.r3d`` archive, or its folder, with images, depths and poses.

``metadata`` (JSON) holds the size ``w``, ``h`` of the images, their ``K`` column by column, ``fps``
and ``poses`` ``qx qy qz qw tx ty tz`` (camera to world, axes of OpenGL); ``rgbd/`` holds
``N.jpg``, ``N.depth`` (float32 metres) and ``N.conf`` (0 to 2), the last two compressed by LZFSE.
"""

import importlib
import json
import re
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from geogs.errors import InputError
from geogs.extras import install_command
from geogs.guard.documents import LARGEST_DOCUMENT, UNUSABLE, read_bytes, require_file
from geogs.io.pictures import LARGEST_PICTURE, decoded_bytes
from geogs.io.pose_files import FRAMES_PER_SECOND, OPENCV_FROM_OPENGL, poses_from
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.data_set_cameras import record3d_camera
from geogs.io.sources.depth_files import LEAST_CONFIDENCE, DepthCamera
from geogs.io.sources.pose_priors import rigid_pose
from geogs.io.sources.reader import RawFrame, RecordingInfo
from geogs.types import MeasuredPose

_NUMBER = re.compile(r"\d{1,18}")
_LIDAR = (192, 256)
"""Rows and columns of depth maps whose size is not given."""
_LARGEST_DEPTH = 1 << 26
"""Largest compressed depth map in bytes."""


def is_record3d(path: Path) -> bool:
    """Whether ``path`` is a Record3D archive, or the folder of an unpacked one."""
    if path.is_dir():
        return (path / "metadata").is_file() and (path / "rgbd").is_dir()
    return path.suffix.lower() == ".r3d" and path.is_file() and zipfile.is_zipfile(path)


@dataclass(frozen=True)
class Files:
    """Files of an unpacked recording, by name."""

    path: Path

    def names(self) -> list[str]:
        """Names of all files, such as ``rgbd/0.jpg``."""
        return [f"rgbd/{p.name}" for p in (self.path / "rgbd").iterdir()]

    def read(self, name: str, largest: int) -> bytes:
        """Content of a file. Raises InputError if it is missing, too large, or damaged."""
        return read_bytes(self.path / name, largest)


class _Archive(Files):
    def names(self) -> list[str]:
        with self._opened() as archive:
            return archive.namelist()

    def read(self, name: str, largest: int) -> bytes:
        with self._opened() as archive:
            try:
                if archive.getinfo(name).file_size > largest:
                    raise InputError(f"{self.path}: {name} is larger than any such file.")
                return archive.read(name)
            except (KeyError, OSError, RuntimeError, NotImplementedError, *_DAMAGED):
                raise InputError(f"{self.path}: {name} is missing or damaged.") from None

    def _opened(self) -> zipfile.ZipFile:
        try:
            return zipfile.ZipFile(require_file(self.path))
        except (OSError, *_DAMAGED):
            raise InputError(f"{self.path} is damaged; export it again.") from None


_DAMAGED = (zipfile.BadZipFile, EOFError, ValueError)


@dataclass(frozen=True)
class Record3dDepth:
    """The depth of a frame, unpacked on demand."""

    files: Files
    number: int
    size: tuple[int, int]
    """Rows and columns."""
    sensor: DepthCamera | None = None
    """None: the depth has the colour image's view, at a lower resolution."""

    def metres(self) -> Float32[np.ndarray, "h w"] | None:
        """The depth of its own pixels, 0 where it is unknown or of low confidence."""
        values = self._unpacked("depth", np.dtype(np.float32))
        if values is None:
            return None
        confidence = self._unpacked("conf", np.dtype(np.uint8))
        known = np.isfinite(values) & (values > 0)
        if confidence is not None:
            known &= confidence >= LEAST_CONFIDENCE
        return np.where(known, values, np.float32(0)).astype(np.float32)

    def _unpacked(self, kind: str, dtype: np.dtype[Any]) -> np.ndarray | None:
        lzfse = _lzfse()
        try:
            packed = self.files.read(f"rgbd/{self.number}.{kind}", _LARGEST_DEPTH)
            data = lzfse.decompress(packed)
        except Exception:  # missing, or any error of the decoder
            return None
        values = np.frombuffer(data[: len(data) // dtype.itemsize * dtype.itemsize], dtype)
        rows, columns = self.size
        return values.reshape(rows, columns) if values.size == rows * columns else None


class Record3dRecording:
    """Reader of a recording."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._files = Files(path) if path.is_dir() else _Archive(path)
        names = [name for name in self._files.names() if name.startswith("rgbd/")]
        pictures = {Path(n).stem: n for n in names if n.endswith((".jpg", ".png"))}
        numbered = ((int(k), name) for k, name in pictures.items() if _NUMBER.fullmatch(k))
        self._images = dict(sorted(numbered))
        """Names of the pictures by frame number."""
        if not self._images:
            raise InputError(f"{path} holds no images in rgbd/; export it again.")
        first = self._picture(next(iter(self._images)))
        if first is None:
            raise InputError(f"{path}: its first image cannot be read; export it again.")
        height, width = first.shape[:2]
        try:
            metadata: dict[str, Any] = json.loads(self._files.read("metadata", LARGEST_DOCUMENT))
            fps = float(metadata.get("fps") or FRAMES_PER_SECOND)
            calibration = _calibration(metadata, width, height)
            self._poses = measured_poses(metadata.get("poses", []))
            self._times = [float(t) for t in metadata.get("frameTimestamps") or []]
            self._size = _whole(metadata, "dh", _LIDAR[0]), _whole(metadata, "dw", _LIDAR[1])
        except UNUSABLE:
            raise InputError(f"{path}: its metadata cannot be understood; copy it again.") from None
        if not (0 < fps < 1e4):
            raise InputError(f"{path}: its metadata says {fps} frames a second.")
        depths = sum(name.endswith(".depth") for name in names)
        fault = ""
        if depths and _lzfse() is None:
            depths = 0
            fault = f"Record3D's depth needs liblzfse: {install_command('record3d')}"
        self.info = RecordingInfo(
            "record3d",
            path.resolve().stem,
            width,
            height,
            fps,
            len(self._images),
            calibration,
            depths=depths,
            depth_fault=fault,
            has_poses=bool(self._poses),
            is_capture=True,
        )

    @property
    def paths(self) -> Sequence[Path]:
        """The archive, or the images of the folder."""
        if not self._path.is_dir():
            return [self._path]
        return [self._path / name for name in self._images.values()]

    def read(self, start: int, stop: int | None, stride: int) -> Iterator[RawFrame]:
        """Read frames ``start, start + stride, ...`` before ``stop``."""
        info = self.info
        has_times = len(self._times) == len(self._images)
        for n, number in list(enumerate(self._images))[start:stop:stride]:
            depth = Record3dDepth(self._files, number, self._size) if info.has_depth else None
            seconds = self._times[n] if has_times else n / info.fps
            pose = self._poses.get(number)
            label = f"{info.name}, frame {number}"
            yield RawFrame(
                label, seconds, self._picture(number), depth=depth, pose=pose, name=str(number)
            )

    def _picture(self, number: int) -> np.ndarray | None:
        try:
            data = self._files.read(self._images[number], LARGEST_PICTURE)
        except InputError:
            return None
        return decoded_bytes(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).rgb


def _calibration(metadata: dict[str, Any], width: int, height: int) -> Calibration | None:
    """The camera for images of a size."""
    if "K" not in metadata:
        return None
    return record3d_camera({"w": width, "h": height, **metadata}).fit(width, height)


def measured_poses(rows: object) -> dict[int, MeasuredPose]:
    """Record3D's ``poses`` by frame number; invalid ones are left out.

    Raises ValueError where they are no table of poses.
    """
    table = np.array(rows, dtype=np.float64)
    if not table.size:
        return {}
    if table.ndim != 2 or table.shape[1] != 7:
        raise ValueError(f"poses of shape {table.shape}")
    found = {}
    for number, row in enumerate(table):
        if not np.isfinite(row).all() or np.linalg.norm(row[:4]) == 0:
            continue
        (T_wc,) = poses_from(row[None, 4:], row[None, :4])
        pose = rigid_pose(T_wc @ OPENCV_FROM_OPENGL)
        if pose is not None:
            found[number] = pose
    return found


def _whole(metadata: dict[str, Any], name: str, default: int) -> int:
    value = metadata.get(name)
    return default if value is None else int(value)


def _lzfse() -> Any:
    """The module that unpacks LZFSE; none where it is not installed."""
    try:
        return importlib.import_module("lzfse")
    except ImportError:
        return None
