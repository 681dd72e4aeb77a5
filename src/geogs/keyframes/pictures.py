"""The images of keyframes and what is made of them, of which only the recent are in memory."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.keyframes.archive import Archive, Archived, Recent


class PictureArchive:
    """Images in a file, and the encoded forms of the ``resident`` ones used last."""

    def __init__(self, encode: Callable[[UInt8[np.ndarray, "h w 3"]], Any], resident: int) -> None:
        self.encode = encode
        self.images = Archive(resident=resident)
        self.normals = Archive()
        self.encoded: Recent[Any] = Recent(resident)


class Picture:
    """A keyframe's image, its encoded form and a prior's normals.

    With an archive they are there when asked for, but not kept; without one they are plain values.
    """

    def __init__(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        encoded: Any,
        archive: PictureArchive | None = None,
    ) -> None:
        self._archive = archive
        self._encoded = None
        self.stored_normal: Float[Tensor, "h w 3"] | Archived | None = None
        self.image = image
        self.encoded = encoded

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """RGB."""
        stored = self.stored_image
        return stored.load() if isinstance(stored, Archived) else stored

    @image.setter
    def image(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        archive = self._archive
        self.stored_image = image if archive is None else archive.images.put(image)

    @property
    def encoded(self) -> Any:
        """The flow operator's form of the image, computed again where it is no longer kept."""
        archive = self._archive
        if archive is None:
            return self._encoded
        return archive.encoded.get(self, lambda: archive.encode(self.image))

    @encoded.setter
    def encoded(self, encoded: Any) -> None:
        if self._archive is None:
            self._encoded = encoded
        else:
            self._archive.encoded.put(self, encoded)

    @property
    def normal(self) -> Float[Tensor, "h w 3"] | None:
        """Unit normals in the camera frame, facing the camera."""
        stored = self.stored_normal
        return torch.from_numpy(stored.load()) if isinstance(stored, Archived) else stored

    @normal.setter
    def normal(self, normal: Float[Tensor, "h w 3"] | None) -> None:
        if normal is None or self._archive is None:
            self.stored_normal = normal
        else:
            self.stored_normal = self._archive.normals.put(normal.cpu().numpy())
