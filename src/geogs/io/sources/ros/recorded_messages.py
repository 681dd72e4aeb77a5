"""Content of ROS messages: pictures (``sensor_msgs/Image``, ``CompressedImage``) and the camera
(``sensor_msgs/CameraInfo``) of unprocessed images."""

from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Shaped

from geogs.errors import InputError
from geogs.io.pictures import DEEP, Decoded, decoded_bytes
from geogs.io.sources.calibration import Calibration

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
"""Names of the types; ``rosbags`` gives those of ROS 1 the same names."""


_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8 rgb16": (3, None),
    "bgr8 bgr16 8uc3 16uc3": (3, cv2.COLOR_BGR2RGB),
    "rgba8 rgba16": (4, cv2.COLOR_RGBA2RGB),
    "bgra8 bgra16 8uc4 16uc4": (4, cv2.COLOR_BGRA2RGB),
    "mono8 mono16 8uc1 16uc1": (1, cv2.COLOR_GRAY2RGB),
    # OpenCV names Bayer patterns by the second row and column, ROS by the first.
    "bayer_rggb8 bayer_rggb16": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8 bayer_bggr16": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8 bayer_gbrg16": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8 bayer_grbg16": (1, cv2.COLOR_BayerGB2RGB),
    "uyvy yuv422 yuv422_uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuyv yuy2 yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yvyu": (2, cv2.COLOR_YUV2RGB_YVYU),
    "nv12": (1, cv2.COLOR_YUV2RGB_NV12),
    "nv21": (1, cv2.COLOR_YUV2RGB_NV21),
    "i420 yuv420": (1, cv2.COLOR_YUV2RGB_I420),
}
"""Values per pixel of a row, and OpenCV's conversion to RGB, by the names of an encoding."""
_BY_NAME = {name: said for names, said in _ENCODINGS.items() for name in names.split()}
_WITH_ROWS_OF_COLOUR = (cv2.COLOR_YUV2RGB_NV12, cv2.COLOR_YUV2RGB_NV21, cv2.COLOR_YUV2RGB_I420)
"""Conversions of images where half as many rows with colours follow those of brightness."""
_MAY_BE_DEPTH = ("16uc1", "mono16")
"""Encodings that are depth on a topic of that name, else pictures of 16 bits."""
_DEPTH = ("32fc1", "compresseddepth")
_DEPTH_TOPICS = ("depth", "disparity")
_COLOURED = 1.0
"""Least mean difference of red and blue in a colour image, as levels of 256: JPEG gives grey ones
less."""
_LARGEST = 1 << 16
"""Longest side in pixels."""
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
"""Name of the type; ``rosbags`` gives that of ROS 1 the same name."""
_FISHEYES = ("equidistant", "fisheye")
_POLYNOMIALS = ("plumb_bob", "rational_polynomial", "")


def shows(message: Any, topic: str) -> Literal["colour", "grey", "depth", ""]:
    """Content of a message of one of the two types; empty where it is not read here."""
    words = str(getattr(message, "format", getattr(message, "encoding", ""))).lower()
    encoding = words.split(";")[0].strip()
    is_depth = any(word in topic.lower() for word in _DEPTH_TOPICS)
    if any(word in words for word in _DEPTH) or (is_depth and encoding in _MAY_BE_DEPTH):
        return "depth"
    if not hasattr(message, "format") and encoding not in _BY_NAME:
        return ""
    picture = picture_of(message).picture
    if picture is None:
        return "grey"
    levels = picture.astype(np.float32) * (1 / 256 if picture.dtype == np.uint16 else 1)
    return "colour" if np.abs(levels[..., 0] - levels[..., 2]).mean() > _COLOURED else "grey"


def picture_of(message: Any) -> Decoded:
    """The RGB image of a message, of any number of bits; none where the message is damaged."""
    if not hasattr(message, "format"):
        return Decoded(_raw(message))
    found = decoded_bytes(np.asarray(message.data, np.uint8), DEEP)
    if found.picture is None:
        return found
    return Decoded(cv2.cvtColor(found.picture, cv2.COLOR_BGR2RGB), found.is_damaged)


def _raw(message: Any) -> Shaped[np.ndarray, "h w 3"] | None:
    """Decode a raw image; its rows may be padded."""
    encoding = str(message.encoding).lower()
    width = message.width
    height = message.height
    if encoding not in _BY_NAME or not (0 < width <= _LARGEST and 0 < height <= _LARGEST):
        return None
    channels, code = _BY_NAME[encoding]
    kind = np.dtype(f"{'>' if message.is_bigendian else '<'}u{2 if '16' in encoding else 1}")
    used = width * channels * kind.itemsize
    lines = height + height // 2 if code in _WITH_ROWS_OF_COLOUR else height
    data = np.asarray(message.data, np.uint8)
    step = used if len(data) == lines * used else message.step
    if len(data) < lines * step or step < used:
        return None
    rows = np.ascontiguousarray(data[: lines * step].reshape(lines, step)[:, :used]).view(kind)
    pixels = rows.astype(kind.newbyteorder("=")).reshape(lines, width, channels)
    if code is None:
        return pixels
    try:
        return cv2.cvtColor(pixels[..., 0] if channels == 1 else pixels, code)
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
    model = str(message.distortion_model).lower()
    distortion = tuple(D) if any(D) and not is_rectified else ()
    is_fisheye = model in _FISHEYES and not is_rectified
    if distortion and model not in (*_FISHEYES, *_POLYNOMIALS):
        raise InputError(
            f"The lens of {topic} is of a model that is not supported; undistort the images first."
        )
    if not is_fisheye and not any(distortion[8:]):
        distortion = distortion[:8]
    # K is for the whole sensor; a region of interest moves its corner, binning only scales.
    roi = message.roi
    is_part = roi.width > 0 and roi.height > 0
    return Calibration(
        fx,
        fy,
        cx - roi.x_offset if is_part else cx,
        cy - roi.y_offset if is_part else cy,
        distortion=distortion,
        width=int(roi.width if is_part else message.width) or None,
        height=int(roi.height if is_part else message.height) or None,
        origin=f"{topic} of the bag",
        lens="fisheye" if is_fisheye else "polynomial",
    )


def _entry(message: Any, name: str) -> list[float]:
    values = getattr(message, name, None)
    return [float(v) for v in (getattr(message, name.upper()) if values is None else values)]
