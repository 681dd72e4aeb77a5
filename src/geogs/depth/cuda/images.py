"""A keyframe's images for the depth kernels."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from geogs.depth.depth_view import DepthView
from geogs.gpu.transfer import upload


@dataclass(frozen=True, eq=False)
class KeyframeImages:
    """The images of a keyframe on the device; grey values lie in [-1/2, 1/2]."""

    grey: Float32[Tensor, "h w"]
    """At the render size, where planes are swept."""
    smooth: Float32[Tensor, "h w"]
    """The same, blurred: where the sweep's depth may jump."""
    colours: Float32[Tensor, "3 h w"]
    """RGB in [0, 1] at the render size."""
    fine: Float32[Tensor, "fh fw"]
    """At the working size, where depth is refined."""

    @staticmethod
    def of(
        view: DepthView, device: torch.device, pixels: Float32[np.ndarray, "n"] | None = None
    ) -> "KeyframeImages":
        """The images of a view, in one transfer; ``pixels`` are its ``image_pixels``."""
        h, w = view.grey.shape
        moved = upload(image_pixels(view) if pixels is None else pixels, device)
        grey, smooth, fine, colours = moved.split([h * w, h * w, view.fine.size, 3 * h * w])
        return KeyframeImages(
            grey.view(h, w), smooth.view(h, w), colours.view(3, h, w), fine.view(view.fine.shape)
        )


def image_pixels(view: DepthView) -> Float32[np.ndarray, "n"]:
    """The pixels of ``KeyframeImages`` in one array."""
    h, w = view.grey.shape
    small = cv2.resize(view.image, (w, h), interpolation=cv2.INTER_AREA)
    colours = small.transpose(2, 0, 1).astype(np.float32) * np.float32(1 / 255)
    smooth = cv2.GaussianBlur(view.grey, (0, 0), 0.7)
    grey = np.concatenate([x.ravel() for x in (view.grey, smooth, view.fine)]) - np.float32(0.5)
    return np.concatenate([grey, colours.ravel()])


def packed(
    A: Float64[np.ndarray, "n 3 3"], b: Float64[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 12"]:
    """The rows of each matrix, then its vector, as the kernels take them."""
    return np.concatenate([A.reshape(-1, 9), b], 1).astype(np.float32)
