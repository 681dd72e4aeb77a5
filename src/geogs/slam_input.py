"""What a system is given: cameras, images and times, checked before anything depends on them."""

from dataclasses import replace
from numbers import Real

import numpy as np
import torch

from geogs.config.arguments import check_fields
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.given_pose import as_pose
from geogs.types import Frame

NARROWEST = 100.0
"""Largest focal length over the longer edge of the image; a field of view of half a degree."""
WIDEST = 0.02
"""Smallest one; a field of view of 175 degrees."""


def require_camera(camera: Camera) -> None:
    """Raise InputError for a camera that no lens makes."""
    ratios = (camera.fx / camera.long_edge, camera.fy / camera.long_edge)
    if not WIDEST <= min(ratios) <= max(ratios) <= NARROWEST:
        raise InputError(
            f"No lens has the focal length {camera.fx:g}, {camera.fy:g} for images of "
            f"{camera.width} x {camera.height}; give it in pixels."
        )
    beyond = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
    if beyond > 2:  # images that were cut from larger ones have theirs outside
        raise InputError(
            f"The principal point {camera.cx:g}, {camera.cy:g} lies far outside of the image; give "
            "it in pixels from the centre of the first one."
        )


def require_mask(mask: object, camera: Camera) -> None:
    """Raise InputError if something is no mask for the images of a camera; None is one of all."""
    if mask is None:
        return
    size = (camera.height, camera.width)
    if not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.shape != size:
        raise InputError(
            f"A mask is an array of bool, {size[0]} x {size[1]} as the images, true where they may "
            "show the scene."
        )


def input_frame(
    image: Frame | np.ndarray | torch.Tensor,
    timestamp: float | None,
    camera: Camera,
    index: int,
    previous: float | None,
) -> Frame:
    """Make a frame from an image.

    Args:
        image: RGB, uint8, of the camera's size; or a frame.
        timestamp: seconds, later than ``previous``, the last frame's; ignored for a frame, which
            has its own. If None, images come 30 times a second.
        index: position in the stream.

    Raises InputError if the image cannot be used.
    """
    if isinstance(image, Frame):
        frame = _checked(image, camera)
    else:
        pixels = image.detach().cpu().numpy() if isinstance(image, torch.Tensor) else image
        check_image(pixels, camera)
        if timestamp is None:
            timestamp = 0.0 if previous is None else previous + 1 / 30
        frame = Frame(index, _seconds(timestamp), pixels)
    if previous is not None and frame.timestamp <= previous:
        raise InputError(
            f"The image is of {frame.timestamp:g} s, the one before of {previous:g} s; times have "
            "to increase."
        )
    return frame


def _seconds(timestamp: object) -> float:
    """Return a time as a number. Raises InputError if it is none, or not finite."""
    is_number = isinstance(timestamp, Real) and not isinstance(timestamp, bool)
    if not is_number or not np.isfinite(float(timestamp)):  # type: ignore[arg-type]
        raise InputError("The time of an image is a finite number of seconds.")
    return float(timestamp)  # type: ignore[arg-type]


def _checked(frame: Frame, camera: Camera) -> Frame:
    """Return a frame with plain numbers and its pose as a tensor.

    Raises InputError if it cannot be used.
    """
    check_fields(frame)
    check_image(frame.image, camera)
    require_mask(frame.mask, camera)
    pose = frame.pose
    if pose is not None:
        pose = replace(pose, T_cw=as_pose(pose.T_cw))
    return replace(frame, index=int(frame.index), timestamp=float(frame.timestamp), pose=pose)


def check_image(image: object, camera: Camera) -> None:
    """Raise InputError if something is no RGB image of a camera's size."""
    if not isinstance(image, np.ndarray):
        raise InputError("An image is an array, uint8 of height x width x 3 (RGB).")
    if image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 1):
        raise InputError(
            "The image is grey; give RGB, as of cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)."
        )
    if image.ndim != 3 or image.shape[2] != 3:
        shape = "x".join(map(str, image.shape))
        raise InputError(f"The image is an array of {shape}; give height x width x 3 (RGB).")
    if image.dtype != np.uint8:
        raise InputError(
            f"The image is of {image.dtype}; give uint8 in 0..255, as of "
            "(255 * image).round().astype(numpy.uint8) where it is in 0..1."
        )
    if image.shape[:2] != (camera.height, camera.width):
        height, width = image.shape[:2]
        raise InputError(
            f"The image is {width} x {height} pixels, the camera {camera.width} x "
            f"{camera.height}; all images must have the camera's size."
        )
