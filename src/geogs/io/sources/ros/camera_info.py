"""The camera of a ``sensor_msgs/CameraInfo`` message, for images as the sensor gave them."""

from typing import Any

from geogs.errors import InputError
from geogs.io.sources.calibration import Calibration

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
"""Name of the type, that of ROS 1 too as ``rosbags`` gives it."""
_FISHEYES = ("equidistant", "fisheye")
_POLYNOMIALS = ("plumb_bob", "rational_polynomial", "")


def calibration_of(message: Any, topic: str, is_rectified: bool) -> Calibration | None:
    """What a message says of the camera; none where it says that this is unknown.

    Args:
        message: of ROS 1 or ROS 2, which call the same things K and k.
        topic: on which it came, for sentences.
        is_rectified: whether the images that it goes with have been rectified already, so that its
            projection matrix holds and no distortion.

    Raises:
        InputError: its lens is of a model that is not supported.
    """
    K, D, P = (_entry(message, name) for name in "kdp")
    fx, fy, cx, cy = (P[0], P[5], P[2], P[6]) if is_rectified else (K[0], K[4], K[2], K[5])
    if fx == 0 or fy == 0:
        return None
    model, distortion = str(message.distortion_model).lower(), tuple(D)
    is_fisheye = model in _FISHEYES and not is_rectified
    if is_rectified or not any(distortion):
        distortion = ()
    elif is_fisheye:
        pass
    elif model not in _POLYNOMIALS:
        raise InputError(
            f"The lens of {topic} is of a model that is not supported; undistort the images first."
        )
    elif len(distortion) > 8 and not any(distortion[8:]):
        distortion = distortion[:8]
    # K is for the whole sensor; a region of interest moves its corner, binning only scales.
    roi = message.roi
    is_part = roi.width > 0 and roi.height > 0
    return Calibration(
        fx, fy,
        cx - roi.x_offset if is_part else cx,
        cy - roi.y_offset if is_part else cy,
        distortion=distortion,
        width=int(roi.width if is_part else message.width) or None,
        height=int(roi.height if is_part else message.height) or None,
        origin=f"{topic} of the bag",
        lens="fisheye" if is_fisheye else "polynomial",
    )  # fmt: skip


def _entry(message: Any, name: str) -> list[float]:
    values = getattr(message, name, None)
    return [float(v) for v in (getattr(message, name.upper()) if values is None else values)]
