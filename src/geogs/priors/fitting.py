"""Images brought to the size that a network takes, and its maps brought back."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from geogs.geometry.camera import Camera
from geogs.priors.card import PriorCard, Resize

_INTERPOLATION = {
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "area": cv2.INTER_AREA,
}


@dataclass(frozen=True)
class FittedImage:
    """An image as a network takes it."""

    pixels: Float[np.ndarray, "1 3 nh nw"]
    size: tuple[int, int]
    """Height and width of the image itself."""
    inner: tuple[int, int]
    """Height and width that the image has within the network's, without padding."""
    top: int
    left: int
    """Padding above and to the left of it."""

    def camera(self, camera: Camera) -> Float[np.ndarray, "1 3 3"]:
        """The camera matrix in pixels of the network's image; pixel centres at integers."""
        inner = camera.resized(self.inner[1], self.inner[0])
        K = inner.matrix().numpy().astype(np.float32)
        K[:2, 2] += self.left, self.top
        return K[None]

    def back(self, values: Float[np.ndarray, "nh nw *c"]) -> Float[np.ndarray, "h w *c"]:
        """A map of the network at the size of the image, without what was padded.

        A map of another resolution than the network's image is first brought to that.
        """
        size = self.pixels.shape[2:]
        if values.shape[:2] != size:
            values = cv2.resize(values, size[::-1], interpolation=cv2.INTER_LINEAR)
        inner = values[self.top : self.top + self.inner[0], self.left : self.left + self.inner[1]]
        if self.inner == self.size:
            return np.ascontiguousarray(inner)
        return cv2.resize(inner, self.size[::-1], interpolation=cv2.INTER_LINEAR)


def fit_image(image: UInt8[np.ndarray, "h w 3"], card: PriorCard) -> FittedImage:
    """An RGB image resized, padded, ordered and normalised as a card says."""
    height, width = image.shape[:2]
    inner, outer = _sizes(height, width, card)
    scaled: np.ndarray = image.astype(np.float32) * np.float32(card.full_scale / 255)
    if inner != (height, width):
        method = _INTERPOLATION[card.interpolation]
        scaled = cv2.resize(scaled, inner[::-1], interpolation=method)
    top, left = (outer[0] - inner[0]) // 2, (outer[1] - inner[1]) // 2
    if inner != outer:
        bottom, right = outer[0] - inner[0] - top, outer[1] - inner[1] - left
        border = cv2.BORDER_CONSTANT
        scaled = cv2.copyMakeBorder(scaled, top, bottom, left, right, border, value=card.padding)
    normal = (scaled - np.array(card.mean, np.float32)) / np.array(card.std, np.float32)
    if card.channels == "bgr":
        normal = normal[..., ::-1]
    pixels = np.ascontiguousarray(normal.transpose(2, 0, 1)[None], np.float32)
    return FittedImage(pixels, (height, width), inner, top, left)


def _sizes(height: int, width: int, card: PriorCard) -> tuple[tuple[int, int], tuple[int, int]]:
    """Height and width of the image within the network's, and those of the latter."""
    if card.resize is Resize.STRETCH:
        inner = outer = (card.height, card.width)
    elif card.resize is Resize.AT_LEAST:
        scale = max(card.height / height, card.width / width)
        inner = outer = (
            _multiple_at_least(height * scale, card.height, card.multiple),
            _multiple_at_least(width * scale, card.width, card.multiple),
        )
    elif card.resize is Resize.PAD:
        scale = min(card.height / height, card.width / width)
        inner = (max(int(height * scale), 1), max(int(width * scale), 1))
        outer = (card.height, card.width)
    else:
        inner = (height, width)
        outer = (-(-height // card.multiple) * card.multiple,
                 -(-width // card.multiple) * card.multiple)  # fmt: skip
    return inner, outer


def _multiple_at_least(size: float, least: int, multiple: int) -> int:
    """The multiple nearest to a size, the next one where that is too small."""
    nearest = round(size / multiple) * multiple
    return nearest if nearest >= least else -(-least // multiple) * multiple
