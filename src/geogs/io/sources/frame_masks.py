"""A folder with a mask for each image, and the mark of masked-out pixels in the image itself.

Masked-out pixels are black, and valid pixels that are black become one level brighter: so
the image carries its mask.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from geogs.errors import InputError
from geogs.io.pictures import read_mask

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".pgm"})
"""Suffixes of mask files."""


class FrameMasks:
    """Masks by the name of their image, or by the number of their frame."""

    def __init__(self, folder: Path) -> None:
        """Raises InputError where the folder holds no pictures."""
        paths = [p for p in sorted(folder.iterdir()) if p.suffix.lower() in SUFFIXES]
        if not paths:
            raise InputError(f"{folder} holds no masks ({', '.join(sorted(SUFFIXES))}).")
        self._by_name = {path.stem: path for path in paths}
        self._by_number = {int(path.stem): path for path in paths if path.stem.isdecimal()}

    def find(self, name: str) -> Path | None:
        """The mask of ``0042.jpg`` or of frame ``42``: ``0042.png``, ``0042.jpg.png``, ``42.png``.

        None where there is no mask: then all pixels are valid.
        """
        stem = Path(name).stem
        for known in (name, stem):
            if known in self._by_name:
                return self._by_name[known]
        return self._by_number.get(int(stem)) if stem.isdecimal() else None

    def read(self, name: str, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"] | None:
        """Read the valid pixels of an image; none where all are valid.

        Raises:
            InputError: the mask is damaged.
        """
        path = self.find(name)
        return None if path is None else read_mask(path, shape)


def masked_out(
    image: UInt8[np.ndarray, "h w 3"], valid: Bool[np.ndarray, "h w"] | None
) -> UInt8[np.ndarray, "h w 3"]:
    """The image with masked-out pixels black, and no others."""
    dark = image.max(-1) == 0
    out = np.where(dark[..., None], np.uint8(1), image)
    return out if valid is None else np.where(valid[..., None], out, np.uint8(0))
