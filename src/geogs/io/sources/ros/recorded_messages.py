"""Content of ROS messages: pictures (``sensor_msgs/Image``, ``CompressedImage``) and the camera
(``sensor_msgs/CameraInfo``) of unprocessed images."""

from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from geogs.errors import InputError
from geogs.io.pictures import Decoded, decoded_bytes
from geogs.io.sources.calibration import Calibration

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
"""Names of the types; ``rosbags`` gives those of ROS 1 the same names."""

# Bytes per pixel, and OpenCV's conversion to RGB; none where it is RGB already.
# OpenCV names Bayer patterns by the second row and column, ROS by the first.
_TO_RGB: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8uc3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8uc4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8uc1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
}
_MONO_16 = "mono16"
_LARGEST = 1 << 16
"""Longest side in pixels."""
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
"""Name of the type; ``rosbags`` gives that of ROS 1 the same name."""
_FISHEYES = ("equidistant", "fisheye")
_POLYNOMIALS = ("plumb_bob", "rational_polynomial", "")


def is_picture(message: Any) -> bool:
    """Whether a message of one of the two types holds a readable colour or grey image.

    Depth and disparity come in the same types.
    """
    if hasattr(message, "format"):
        return "compresseddepth" not in str(message.format).lower()
    encoding = str(message.encoding).lower()
    return encoding in _TO_RGB or encoding == _MONO_16


def picture_of(message: Any) -> Decoded:
    """The RGB image of a message; none where the message is damaged."""
    if not hasattr(message, "format"):
        return Decoded(_raw(message))
    found = decoded_bytes(np.asarray(message.data, np.uint8), cv2.IMREAD_COLOR)
    return Decoded(found.rgb, found.is_damaged)


def _raw(message: Any) -> UInt8[np.ndarray, "h w 3"] | None:
    """Decode a raw image; rows may be padded, and 16-bit grey loses the lower eight bits."""
    encoding, width, height = str(message.encoding).lower(), message.width, message.height
    is_16_bit = encoding == _MONO_16
    bytes_a_pixel, code = (2, None) if is_16_bit else _TO_RGB.get(encoding, (0, None))
    data, step = np.asarray(message.data, np.uint8), message.step
    is_sized = 0 < width <= _LARGEST and 0 < height <= _LARGEST
    is_whole = len(data) >= height * step and step >= width * bytes_a_pixel > 0
    if not (is_sized and is_whole):
        return None
    rows = data[: height * step].reshape(height, step)[:, : width * bytes_a_pixel]
    pixels = np.ascontiguousarray(rows).reshape(height, width, bytes_a_pixel)
    if is_16_bit:
        upper = pixels[..., 0 if message.is_bigendian else 1]
        return np.repeat(upper[..., None], 3, axis=2)
    if code is None:
        return pixels
    try:
        return cv2.cvtColor(pixels[..., 0] if bytes_a_pixel == 1 else pixels, code)
    except cv2.error:  # such as YUV of an odd width
        return None


def calibration_of(message: Any, topic: str, is_rectified: bool) -> Calibration | None:
    """The calibration in a message; none where it marks it as unknown.

    Args:
        message: of ROS 1 or ROS 2, which name the entries K and k.
        topic: its topic, for error messages.
        is_rectified: whether its images have been rectified already, so that its projection
            matrix applies, without distortion.

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
