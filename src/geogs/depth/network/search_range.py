"""Depth range of the network's search from the tracker's depths, as in its training."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

RATIO = (6.0, 60.0)
"""Bounds of the ratio of far to near."""
_FEW = 8
"""Least number of known depths."""
_BEYOND = 2.0
"""Factor beyond the 5 % nearest and farthest depths."""


@dataclass(frozen=True)
class SearchRange:
    """Depths, map units."""

    near: float
    far: float
    typical: float
    """Approximate median depth."""


def search_range(
    seen: Float[np.ndarray, "n"],
    own: Float[np.ndarray, "m"],
    limits: tuple[float, float] | None = None,
) -> SearchRange:
    """Search range of a keyframe.

    ``seen`` are the known inverse depths in its view, from all views; ``own`` are its own, whose
    median gives the typical depth. ``limits``, the nearest and farthest depth if they are given,
    may exceed ``RATIO``.
    """
    if limits is not None:
        near, far = limits
    elif len(seen) < _FEW:
        near, far = 0.1, 10.0
    else:
        high, low = np.percentile(seen, [5, 95])
        near, far = 1.0 / (_BEYOND * low), _BEYOND / high
        near *= max(far / near / RATIO[1], 1.0) ** 0.5
        far = min(far, RATIO[1] * near)
    wider = max(RATIO[0] * near / far, 1.0) ** 0.5
    near, far = float(near / wider), float(far * wider)
    if len(own) < _FEW:
        return SearchRange(near, far, (near * far) ** 0.5)
    return SearchRange(near, far, float(np.clip(1.0 / np.median(own), near, far)))
