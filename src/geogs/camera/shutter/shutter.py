"""The shutter of a video."""

import math
from dataclasses import dataclass

from geogs.errors import InputError

LONGEST = 0.1
"""Seconds; no camera takes longer to read an image."""


@dataclass(frozen=True)
class Shutter:
    """Time that the sensor takes from its first line to its last."""

    readout: float = 0.0
    """Seconds; 0 is a global shutter, negative where the last line is read first."""
    origin: str = "taken for a global shutter"
    """Source of the readout, for the log and ``intrinsics.json``."""
    error: float = 0.0
    """Standard error if estimated from the video or undetermined, seconds; 0 if given."""

    @property
    def is_told(self) -> bool:
        """Whether the shutter, even a global one, was estimated or given."""
        return self.readout != 0 or (self.error == 0 and self != Shutter())

    def __post_init__(self) -> None:
        if not (math.isfinite(self.readout) and abs(self.readout) <= LONGEST):
            raise InputError(
                f"A readout of {self.readout:g} s cannot be; give seconds, at most {LONGEST:g}."
            )
