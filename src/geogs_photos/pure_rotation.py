"""Whether a reconstruction is of a camera that only turned.

Through a lens whose focal length is a little wrong, what a turn does to images looks like parallax,
and points at made-up distances explain it to a tenth of a pixel. A turn through another focal
length then does so as well, and with less freedom; of a camera that moved, however little, no one
focal length does.
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
"""Pairs of pictures that are asked; evenly spread ones of more."""
NEARLY_ALL = 0.9
"""Part of them that a turn has to explain as well as the poses do."""
DEVIATION = 0.5
"""Pixels by which matches are off, at least."""
_FOCAL, _STEP = 0.3, 0.01
"""Logarithms: most by which the focal length may be wrong, and how finely it is looked for."""


def only_rotates(model: Any, database: Path) -> bool:
    """Whether a turn alone explains the matches of nearly all pairs of a reconstruction's pictures.

    One focal length serves all pairs: that at which turns leave matches least far off. Which model
    a pair speaks for is decided by Torr's criterion (:func:`gric`).
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
    """How far the best turn leaves matches off, pixels, where the logarithm of the focal length is
    so much longer."""
    times = float(np.exp(longer))
    one, two = (rays / [times, times, 1.0] for rays in pair.rays)
    return times * pair.focal * best_rotation(one, two)[1]
