"""The images of keyframes and what is made of them, of which only the recent are in memory."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from geogs.world.archive import Archive, Archived
from geogs.world.swap import Swap

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
        self.depths = Archive()
        self.encoded: Swap[Picture, Any] = Swap(resident)

    def add(self, image: UInt8[np.ndarray, "h w 3"], encoded: Any = None) -> "Picture":
        """Put an image into its archive; ``encoded`` is the flow operator's form of it."""
        picture = Picture(self, self.images.put(image))
        if self.encode is None:
            picture.own_encoded = encoded
        else:
            self.encoded.put(picture, encoded)
        return picture


class Picture:
    """A keyframe's image, its encoded form, a prior's normals and a sensor's depth, read when they
    are asked for."""

    def __init__(
        self,
        pictures: Pictures,
        archived: Archived,
        archived_normal: Archived | None = None,
        archived_depth: Archived | None = None,
    ) -> None:
        self._pictures = pictures
        self.archived = archived
        """The image in its archive."""
        self.archived_normal = archived_normal
        self.archived_depth = archived_depth
        self.own_encoded: Any = None
        """The encoded form, where it cannot be made again."""

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """RGB at working resolution; not to be changed in place."""
        return self.archived.load()

    @property
    def encoded(self) -> Any:
        """The flow operator's form of the image, computed again where it is no longer kept."""
        encode = self._pictures.encode
        if encode is None:
            return self.own_encoded
        return self._pictures.encoded.get(self, lambda: encode(self.image))

    @property
    def normal(self) -> Float[Tensor, "h w 3"] | None:
        """A monocular prior's unit normals at working resolution, in the camera frame and facing
        the camera; zero where unknown, None where nothing was asked."""
        normal = self.archived_normal
        return None if normal is None else torch.from_numpy(normal.load())

    @normal.setter
    def normal(self, normal: Float[Tensor, "h w 3"]) -> None:
        self.archived_normal = self._pictures.normals.put(normal.cpu().numpy())

    @property
    def depth(self) -> Float32[np.ndarray, "h w"] | None:
        """What a depth sensor saw, metres at working resolution, 0 where unknown; None without."""
        depth = self.archived_depth
        return None if depth is None else depth.load().astype(np.float32)

    @depth.setter
    def depth(self, metres: Float32[np.ndarray, "h w"]) -> None:
        # Half precision rounds by 0.05 %, a tenth of what a sensor errs.
        self.archived_depth = self._pictures.depths.put(metres.astype(np.float16))
