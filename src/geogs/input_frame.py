"""Input images from programs, checked before anything changes."""

from dataclasses import replace

import numpy as np
import torch

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.given_pose import as_pose
from geogs.types import Frame


def input_frame(
    image: Frame | np.ndarray | torch.Tensor,
    timestamp: float | None,
    camera: Camera,
    index: int,
    previous: float | None,
) -> Frame:
    """Make a frame from an image.

    Args:
        image: RGB, uint8, undistorted, of the camera's size; or a frame of a source, which has
            checked it.
        timestamp: seconds, later than ``previous``, the last frame's; ignored for a frame, which
            has its own. If None, images come 30 times a second.
        index: position in the stream.

    Raises InputError if the image cannot be used.
    """
    if isinstance(image, Frame):
        pose = image.pose
        return (
            image if pose is None else replace(image, pose=replace(pose, T_cw=as_pose(pose.T_cw)))
        )
    if isinstance(image, torch.Tensor):
        image = image.cpu().numpy()
    if timestamp is None:
        seconds = 0.0 if previous is None else previous + 1 / 30
    else:
        seconds = float(timestamp)
    check_image(image, camera)
    if not np.isfinite(seconds):
        raise InputError("The time of an image is a finite number of seconds.")
    if previous is not None and seconds <= previous:
        raise InputError(
            f"The image is of {seconds:g} s, the one before of {previous:g} s; times have to "
            "increase."
        )
    return Frame(index, seconds, image)


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
