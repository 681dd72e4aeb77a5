"""The readout of a rolling shutter as the video tells it, and when it is believed."""

import math
from dataclasses import dataclass

import numpy as np

LONGEST, SHORTEST = 0.036, 0.002
"""Seconds of a readout that is believed; less is nothing to care about."""
LEAST_EVIDENCE = 4.0
"""Standard errors by which the readout differs from a global shutter's."""


@dataclass(frozen=True)
class FoundReadout:
    """The readout of a video, as far as the video tells it."""

    best: float = 0.0
    """Readout at which the matches fit best, believed or not, seconds."""
    error: float = math.inf
    """Standard error of the best, seconds; infinite where the video does not tell."""

    @property
    def is_believed(self) -> bool:
        """Whether the video says that its shutter rolls."""
        is_clear = self.best >= max(LEAST_EVIDENCE * self.error, SHORTEST)
        return is_clear and self.best - self.error <= LONGEST

    @property
    def readout(self) -> float:
        """Seconds; 0 where no other is believed."""
        return min(self.best, LONGEST) if self.is_believed else 0.0

    @property
    def left_open(self) -> float:
        """Root mean square of what the readout may differ by from the one that counts, seconds.

        Where it counts as 0, by Bayes' rule: before the video was asked, every second shutter
        rolls, as likely in any time from ``SHORTEST`` to ``LONGEST`` as in another. Where the video
        says nothing, that is 15 ms.
        """
        if self.is_believed:
            return self.error
        rolling = np.linspace(SHORTEST, LONGEST, 500)
        readouts = np.append(np.zeros_like(rolling), rolling)
        fit = -0.5 * np.square((readouts - self.best) / self.error)
        likely = np.exp(fit - fit.max())
        return float(np.sqrt(likely @ readouts**2 / likely.sum()))
