"""Cameras as data sets and apps write them: KITTI, ARKitScenes, ScanNet++, Record3D.

KITTI (Geiger et al., "Vision meets robotics", IJRR 2013): images that were rectified have the
camera in the left 3x3 of ``P0`` to ``P3`` (odometry) or ``P_rect_00`` to ``P_rect_03`` (raw), and
the others have ``K_..`` and ``D_..`` (k1, k2, p1, p2, k3).
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from geogs.errors import InputError
from geogs.guard.documents import read_text, whole_number
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.camera_keys import MOST_SKEW

_ROW = re.compile(r"(\w+):\s*(.*)")
_PROJECTION = re.compile(r"P(?:_rect_0)?([0-3])")
SAME = 1e-6
"""Relative difference up to which cameras count as one."""


def kitti_rows(text: str) -> dict[str, list[float]]:
    """Rows of numbers of a KITTI calibration, by name; rows of words are left out."""
    rows = {}
    for name, words in _ROW.findall(text):
        try:
            rows[name] = [float(word) for word in words.split()]
        except ValueError:
            continue
    return rows


def is_kitti(text: str) -> bool:
    """Whether a text is a calibration of KITTI."""
    return any(_PROJECTION.fullmatch(name) for name, _ in _ROW.findall(text))


def kitti_camera(path: Path, number: int | None, rectified: bool = True) -> Calibration:
    """Read camera ``number`` (0 to 3) of a KITTI file; without a number, the camera they share.

    Raises:
        InputError: it is not there, or cameras differ and none was named.
        ValueError, LookupError: its row holds something else.
    """
    rows = kitti_rows(read_text(path))
    numbers = range(4) if number is None else (number,)
    found = [c for n in numbers if (c := _kitti_camera(rows, path, n, rectified)) is not None]
    if not found:
        raise InputError(f"{path} holds no camera {number or 0}; is it KITTI's calibration?")
    pinholes = np.array([(c.fx, c.fy, c.cx, c.cy) for c in found])
    if np.ptp(pinholes, axis=0).max() > SAME * pinholes.max():
        raise InputError(
            f"{path} holds cameras that differ; give the folder of images with it, or numbers."
        )
    return found[0]


def kitti_offset(path: Path, number: int) -> Float64[np.ndarray, "3"]:
    """Position of camera 0 in the axes of a rectified camera, metres.

    Raises:
        InputError: the file does not hold it.
    """
    rows = kitti_rows(read_text(path))
    P = rows.get(f"P{number}", rows.get(f"P_rect_{number:02d}", []))
    if len(P) != 12:
        raise InputError(f"{path} holds no camera {number}; is it KITTI's calibration?")
    projection = np.array(P, dtype=np.float64).reshape(3, 4)
    try:
        return np.linalg.solve(projection[:, :3], projection[:, 3])
    except np.linalg.LinAlgError:
        raise InputError(f"{path} holds no camera {number}; copy it again.") from None


def arkit_camera(path: Path) -> Calibration:
    """``width height fx fy cx cy`` of a ``.pincam``. Raises ValueError for something else."""
    width, height, fx, fy, cx, cy = (float(word) for word in read_text(path).split())
    size = whole_number(width), whole_number(height)
    return Calibration(fx, fy, cx, cy, (), *size, origin=str(path))


def scannetpp_camera(document: dict[str, Any], path: Path) -> Calibration:
    """The median of all frames of ``pose_intrinsic_imu.json``. Raises ValueError, KeyError."""
    K = np.median([frame["intrinsic"] for frame in document.values()], axis=0)
    return Calibration(*pinhole_of(K), origin=str(path))


def pinhole_of(values: Any) -> tuple[float, float, float, float]:
    """fx, fy, cx and cy of a matrix, nine numbers by rows or, as Record3D has them, by columns.

    Raises:
        InputError: pixels are skewed.
        ValueError: it is something else.
    """
    K = np.array(values, dtype=np.float64).reshape(3, 3)
    if K[2, :2].any():
        K = K.T
    if abs(K[0, 1]) > MOST_SKEW:
        raise InputError(f"A camera matrix with skew {K[0, 1]:g} is not supported; undistort.")
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def record3d_camera(metadata: dict[str, Any]) -> Calibration:
    """``K``, ``w`` and ``h`` of Record3D's ``metadata``. Raises ValueError, KeyError."""
    size = whole_number(metadata["w"]), whole_number(metadata["h"])
    return Calibration(*pinhole_of(metadata["K"]), (), *size, origin="Record3D")


def _kitti_camera(
    rows: dict[str, list[float]], path: Path, number: int, rectified: bool
) -> Calibration | None:
    P = rows.get(f"P{number}", rows.get(f"P_rect_{number:02d}"))
    K = rows.get(f"K_{number:02d}")
    size = rows.get(f"S_rect_{number:02d}" if rectified else f"S_{number:02d}", [None, None])
    width, height = (None if n is None else whole_number(n) for n in size)
    if not rectified and K is not None:
        fx, _, cx, _, fy, cy = K[:6]
        distortion = tuple(rows.get(f"D_{number:02d}", ()))
    elif P is not None:
        fx, _, cx, _, _, fy, cy = P[:7]
        distortion = ()
    else:
        return None
    return Calibration(fx, fy, cx, cy, distortion, width, height, origin=str(path))
