"""Sparse features matched between two images of which nothing is known.

Dense flow is a local search: from a cold start it finds motions up to some twenty pixels, and loses
small things that move by more than their size. Features are compared each with all, so that their
matches may be anywhere; those that obey one epipolar geometry give the dense flow a start.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.device_choice import grid_fields
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

FEATURES = 2000
"""Most features per image."""
MIN_CONTRAST = 0.01
"""Fraction of the range of grey levels: OpenCV's is 0.04, which leaves a road empty."""
MAX_RATIO = 0.85
"""Largest distance to the most alike feature relative to that of the next."""
EPIPOLAR_ERROR = 1.5
"""Pixels from the epipolar line within which a match obeys it."""
MIN_DENSE = 0.4
"""Fraction of matched cells below which features are tried; where a third of the cells find nothing
but motions beyond the dense search, half of what it does find is wrong."""
MIN_MATCHES = 40
"""Fewest matches of one epipolar geometry that are believed; unlike images have about ten."""


@dataclass(frozen=True)
class FeatureMatches:
    """Positions of the same features in two images."""

    first: Float[Tensor, "n 2"]
    """Pixels, float32, on the CPU."""
    second: Float[Tensor, "n 2"]

    def __len__(self) -> int:
        return len(self.first)


def match_features(
    first: Float[Tensor, "h w"], second: Float[Tensor, "h w"]
) -> FeatureMatches | None:
    """SIFT features (Lowe 2004) of two images in grey levels that obey one epipolar geometry.

    Matches are mutual and pass the ratio test. None where there are too few.
    """
    sift = cv2.SIFT.create(FEATURES, contrastThreshold=MIN_CONTRAST)
    (points_a, a), (points_b, b) = (_described(sift, image) for image in (first, second))
    if min(len(points_a), len(points_b)) < MIN_MATCHES:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(b, a)}
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, other in matcher.knnMatch(a, b, 2)
        if best.distance < MAX_RATIO * other.distance and back[best.trainIdx] == best.queryIdx
    ]
    if len(pairs) < MIN_MATCHES:
        return None
    p, q = (np.stack(x) for x in ([points_a[i] for i, _ in pairs], [points_b[j] for _, j in pairs]))
    try:
        F, agree = cv2.findFundamentalMat(p, q, cv2.USAC_MAGSAC, EPIPOLAR_ERROR, 0.999, 2000)
    except cv2.error:  # OpenCV 5 fails an assertion where no sample gives a model
        return None
    if F is None or int(agree.sum()) < MIN_MATCHES:
        return None
    kept = agree[:, 0] > 0
    return FeatureMatches(torch.from_numpy(p[kept]), torch.from_numpy(q[kept]))


def guided_flow(
    grid: SampleGrid,
    operator: FlowOperator,
    first: Any,
    second: Any,
    there: FlowMatch,
    back: FlowMatch,
) -> tuple[FlowMatch, FlowMatch]:
    """The given flow between two encoded images, or one that starts from their matched features.

    That is measured where less than ``MIN_DENSE`` of the given one is matched, and taken unless it
    matches not even half as much: a dense search that has lost its way agrees with itself, too.
    """
    fraction = _matched(there)
    if fraction >= MIN_DENSE:
        return there, back
    found = match_features(operator.grey(first), operator.grey(second))
    if found is None:
        return there, back
    forward = spread_positions(grid, found.first, found.second)
    backward = spread_positions(grid, found.second, found.first)
    seeded = operator.measure([first], [second], forward[None], backward[None], fine=False)
    return seeded if _matched(seeded[0]) > 0.5 * fraction else (there, back)


def guided_flows(
    grid: SampleGrid, operator: FlowOperator, first: list[Any], second: list[Any]
) -> list[tuple[FlowMatch, FlowMatch]]:
    """The same of pairs of images, from a cold start: from the first to the second, and back."""
    matches = operator.measure(first, second, fine=False)
    found = []
    for n, pair in enumerate(zip(first, second, strict=True)):
        there, back = (FlowMatch(m.pixels[n : n + 1], m.weight[n : n + 1]) for m in matches)
        found.append(guided_flow(grid, operator, *pair, there, back))
    return found


def spread_positions(
    grid: SampleGrid, points: Float[Tensor, "n 2"], moved: Float[Tensor, "n 2"]
) -> Float[Tensor, "p 2"]:
    """Where the cells of an image go if its points go to ``moved``: as those around them."""
    cell, inside = grid.cells_of(points)
    cell, flow = cell[inside], (moved - points)[inside]
    total = torch.zeros(grid.size, 2).index_add_(0, cell, flow)
    count = torch.zeros(grid.size).index_add_(0, cell, torch.ones(len(cell)))
    mean, count = (total / count.clamp(min=1)[:, None]).to(grid.device), count.to(grid.device)
    return grid.pixels + grid_fields(grid).fill(mean.mT.contiguous(), count.expand(2, -1)).mT


def _matched(match: FlowMatch) -> float:
    """Fraction of the cells of an edge that are matched."""
    return float((match.weight[0, :, 0] > 0).float().mean())


def _described(sift: cv2.SIFT, image: Float[Tensor, "h w"]) -> tuple[np.ndarray, np.ndarray]:
    """Positions and descriptors of an image's features."""
    grey = image.round().clamp(0, 255).byte().cpu().numpy()
    points, descriptors = sift.detectAndCompute(grey, None)
    pixels = np.array([p.pt for p in points], np.float32).reshape(-1, 2)
    return pixels, np.zeros((0, 128), np.float32) if descriptors is None else descriptors
