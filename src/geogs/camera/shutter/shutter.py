"""The shutter of a video: its readout, given or estimated, and conditions for its acceptance."""

import math
from dataclasses import dataclass

import numpy as np

from geogs.errors import InputError

MOST = 0.1
"""Seconds; no camera takes longer to read an image."""
LONGEST, SHORTEST = 0.036, 0.002
"""Longest and shortest accepted readout, seconds; a shorter one does not matter."""
LEAST_EVIDENCE = 4.0
"""Least readout that is accepted, in standard errors."""


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
        if not (math.isfinite(self.readout) and abs(self.readout) <= MOST):
            raise InputError(
                f"A readout of {self.readout:g} s cannot be; give seconds, at most {MOST:g}."
            )


@dataclass(frozen=True)
class FoundReadout:
    """Readout estimated from a video."""

    best: float = 0.0
    """Readout at which the matches fit best, accepted or not, seconds."""
    error: float = math.inf
    """Standard error of the best, seconds; infinite where the video does not determine it."""

    @property
    def is_believed(self) -> bool:
        """Whether a rolling shutter is accepted."""
        is_clear = self.best >= max(LEAST_EVIDENCE * self.error, SHORTEST)
        return is_clear and self.best - self.error <= LONGEST

    @property
    def readout(self) -> float:
        """Accepted readout, seconds; 0 if none is accepted."""
        return min(self.best, LONGEST) if self.is_believed else 0.0

    @property
    def left_open(self) -> float:
        """Root mean square error of ``readout``, seconds.

        Where none is accepted, by Bayes' rule: a priori every second shutter rolls, with a readout
        uniform from ``SHORTEST`` to ``LONGEST``. Without any data, that is 15 ms.
        """
        if self.is_believed:
            return self.error
        rolling = np.linspace(SHORTEST, LONGEST, 500)
        readouts = np.append(np.zeros_like(rolling), rolling)
        fit = -0.5 * np.square((readouts - self.best) / self.error)
        likely = np.exp(fit - fit.max())
        return float(np.sqrt(likely @ readouts**2 / likely.sum()))
