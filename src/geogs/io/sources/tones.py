"""Pictures of more than 8 bits as pictures of 8: one map for all pictures of a recording."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from geogs.io.pictures import DEEP, decoded
from geogs.io.sources.account import Account

_BITS = (8, 10, 12, 14, 16)
"""Numbers of bits that cameras give."""
_PERCENTILES = (0.5, 99.5)
_NARROW = 1 / 8
"""Fraction of the range of the bits in use, below which the pixels' own range is stretched: less
than 32 of 256 levels of grey would remain."""
_MARGIN = 0.1
"""Fraction of the pixels' own range that is added on both sides for pictures not asked."""
_STRIDE = 4
"""Every such row and column is asked."""
ASKED = 24
"""Approximate number of pictures that are asked."""
_HAVE_8_BITS = (".jpg", ".jpeg", ".bmp", ".webp")
"""Endings of pictures that never have more."""


@dataclass(frozen=True, slots=True)
class Tones:
    """The range of stored values that becomes 0 to 255."""

    low: float = 0.0
    high: float = 65536.0
    """The value that would become 256."""
    sentence: str = ""
    """Assumption, for the account of the input; empty for the upper 8 of 16 bits."""

    def __call__(self, picture: np.ndarray) -> UInt8[np.ndarray, "..."]:
        """The picture in 8 bits; one that has 8 bits as it is."""
        if picture.dtype == np.uint8:
            return picture
        is_looked_up = picture.dtype == np.uint16
        values = np.arange(65536) if is_looked_up else picture
        scale = 256 / (self.high - self.low)
        levels = (np.nan_to_num(values.astype(np.float32)) - self.low) * scale
        mapped = levels.clip(0, 255).astype(np.uint8)
        return mapped[picture] if is_looked_up else mapped

    def rgb(self, picture: np.ndarray | None) -> UInt8[np.ndarray, "h w 3"] | None:
        """A picture in OpenCV's order of channels as RGB in 8 bits; none of none."""
        return None if picture is None else cv2.cvtColor(self(picture), cv2.COLOR_BGR2RGB)

    @property
    def account(self) -> Account:
        """Account of the assumption."""
        return Account((self.sentence,) if self.sentence else ())


UPPER_BITS = Tones()
"""The upper 8 of 16 bits."""


def tones_of(pictures: Iterable[np.ndarray]) -> Tones:
    """The map for the pictures of a recording, from a sample of them."""
    values = [p[::_STRIDE, ::_STRIDE].ravel() for p in pictures if p.dtype != np.uint8]
    values = [v[np.isfinite(v)] for v in values]
    if not sum(map(len, values)):
        return UPPER_BITS
    seen = np.concatenate(values)
    low, high = map(float, np.percentile(seen, _PERCENTILES))
    whole = 0.0
    if seen.dtype.kind != "f" and seen.min() >= 0:
        bits = next((b for b in _BITS if int(seen.max()) < 1 << b), 32)
        whole = float(1 << bits)
        if high - low >= _NARROW * whole:
            said = "" if bits == 16 else f"pictures use {bits} of their {8 * seen.itemsize} bits"
            return Tones(0.0, whole, said)
    if high <= low:
        return Tones(low, low + max(1.0, whole))
    margin = _MARGIN * (high - low)
    said = f"values from {low:.6g} to {high:.6g} of pictures become black and white"
    return Tones(low - margin, high + margin, said)


def tones_of_files(files: Sequence[Path]) -> Tones:
    """The map for picture files, of which some are read if the first has more than 8 bits."""
    files = [path for path in files if path.suffix.lower() not in _HAVE_8_BITS]
    first = decoded(files[0], DEEP).picture if files else None
    if first is None or first.dtype == np.uint8:
        return UPPER_BITS
    found = (decoded(path, DEEP).picture for path in files[:: max(1, len(files) // ASKED)])
    return tones_of(picture for picture in found if picture is not None)
