"""Where points that each image sees at their own time are at one time."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

AROUND = 2
"""Images before and after one whose points tell how these move."""


@dataclass(frozen=True)
class Passage:
    """Points of the middle one of some neighbouring images, as they pass by."""

    plane: Float[np.ndarray, "k n 2"]
    """x/z and y/z in every image."""
    line_times: Float[np.ndarray, "k n"]
    """Readouts from the middle row of the image to that of the point."""
    times: Float[np.ndarray, "k"]
    """Seconds of the middle rows, from that of the middle image."""

    def at_once(self, readout: float) -> Float[np.ndarray, "n 2"]:
        """Where all points are at the time of the middle row of the middle image.

        By Lagrange's polynomial through the places of a point at the times that it is seen at, so
        that turning, moving and depth need not be known.
        """
        when = self.times[:, None] + readout * self.line_times
        places = np.zeros(self.plane.shape[1:])
        for k, at in enumerate(when):
            weight = np.ones(len(at))
            for other in (*when[:k], *when[k + 1 :]):
                weight *= other / (other - at)
            places += weight[:, None] * self.plane[k]
        return places
