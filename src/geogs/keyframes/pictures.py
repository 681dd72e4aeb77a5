"""The images of keyframes and what is made of them, of which only the recent are in memory."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.keyframes.archive import Archive, Archived
from geogs.keyframes.swap import Swap

Encode = Callable[[UInt8[np.ndarray, "h w 3"]], Any]
"""A flow operator's form of an image."""


class Pictures:
    """Where the images of keyframes are: the ``resident`` ones used last in memory, all in a file.

    Without ``encode`` encoded forms cannot be made again, so all of them stay in memory.
    """

    def __init__(self, encode: Encode | None, resident: int) -> None:
        self.encode = encode
        self.images = Archive(resident=resident)
        self.normals = Archive()
        self.encoded: Swap[Picture, Any] = Swap(resident)


class Picture:
    """A keyframe's image, its encoded form and a prior's normals, read when they are asked for."""

    def __init__(
        self, pictures: Pictures, image: UInt8[np.ndarray, "h w 3"], encoded: Any = None
    ) -> None:
        self._pictures = pictures
        self._encoded = encoded if pictures.encode is None else None
        self._normal: Archived | None = None
        self.archived = pictures.images.put(image)
        """The image in its archive."""
        if pictures.encode is not None:
            pictures.encoded.put(self, encoded)

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """RGB at working resolution; not to be changed in place."""
        return self.archived.load()

    @property
    def encoded(self) -> Any:
        """The flow operator's form of the image, computed again where it is no longer kept."""
        encode = self._pictures.encode
        if encode is None:
            return self._encoded
        return self._pictures.encoded.get(self, lambda: encode(self.image))

    @property
    def normal(self) -> Float[Tensor, "h w 3"] | None:
        """A monocular prior's unit normals at working resolution, in the camera frame and facing
        the camera; zero where unknown, None where nothing was asked."""
        return None if self._normal is None else torch.from_numpy(self._normal.load())

    @normal.setter
    def normal(self, normal: Float[Tensor, "h w 3"]) -> None:
        self._normal = self._pictures.normals.put(normal.cpu().numpy())
