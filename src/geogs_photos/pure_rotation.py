"""Test whether the camera of a reconstruction only rotated.

With a slightly wrong focal length, a rotation looks like parallax, and points at arbitrary
distances explain it to a tenth of a pixel. A rotation with another focal length explains it as
well, with fewer parameters; no focal length does so for a camera that moved, however little.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize_scalar

from geogs.tracking.matching.two_view_rotation import gric
from geogs_photos.contradictions import best_rotation
from geogs_photos.incremental_mapping import placed_images
from geogs_photos.verified_matches import MAX_ERROR, PairMatches, verified_matches

PAIRS = 60
"""Largest number of tested pairs of pictures; evenly spread ones of more."""
NEARLY_ALL = 0.9
"""Least fraction of them that a rotation has to explain as well as the poses do."""
DEVIATION = 0.5
"""Least standard deviation of matches, pixels."""
_FOCAL, _STEP = 0.3, 0.01
"""Range and resolution of the search for the logarithm of the focal length's correction."""


def only_rotates(model: Any, database: Path) -> bool:
    """Whether a rotation alone explains the matches of nearly all pairs of pictures.

    All pairs have one focal length, with which rotations leave the smallest residuals. Torr's
    criterion (:func:`gric`) selects the model of each pair.
    """
    images = [image.image_id for image in placed_images(model)]
    pairs = list(verified_matches(model, database, images))
    pairs = pairs[:: -(-len(pairs) // PAIRS) or 1]
    if not pairs:
        return False
    deviation = max(DEVIATION, float(model.compute_mean_reprojection_error()))
    found = minimize_scalar(
        lambda longer: np.concatenate([_off(p, longer).clip(max=MAX_ERROR) for p in pairs]).mean(),
        bounds=(-_FOCAL, _FOCAL), method="bounded", options={"xatol": _STEP},
    )  # fmt: skip
    explained = [
        gric((_off(p, found.x) / deviation) ** 2, 2, 3)
        <= gric((p.epipolar() / deviation) ** 2, 3, 5)
        for p in pairs
    ]
    return float(np.mean(explained)) >= NEARLY_ALL


def _off(pair: PairMatches, longer: float) -> Float64[np.ndarray, "n"]:
    """Residuals of matches after the best rotation, pixels, if the logarithm of the focal length is
    larger by ``longer``."""
    times = float(np.exp(longer))
    one, two = (rays / [times, times, 1.0] for rays in pair.rays)
    return times * pair.focal * best_rotation(one, two)[1]
