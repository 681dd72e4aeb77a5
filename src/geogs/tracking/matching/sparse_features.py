"""Matching of sparse features between two images without any prior.

Dense flow is a local search: from a cold start it finds motions up to some twenty pixels, and loses
small objects that move by more than their size. Each feature is compared with all, so that matches
may be anywhere; those that agree with one epipolar geometry give the dense flow a start.
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
"""Contrast threshold as a fraction of the range of grey levels: OpenCV's default of 0.04 finds no
features on a road."""
MAX_RATIO = 0.85
"""Largest ratio of the distances to the most similar feature and the second."""
EPIPOLAR_ERROR = 1.5
"""Largest distance of an inlier from its epipolar line, pixels."""
MIN_DENSE = 0.4
"""Matched fraction of cells below which features are tried; where a third of the cells move beyond
the range of the dense search, half of its matches are wrong."""
MIN_MATCHES = 40
"""Fewest accepted matches of one epipolar geometry; images of different scenes have about ten."""


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
    """Match SIFT features (Lowe 2004) of two grey images that agree with one epipolar geometry.

    Matches are mutual and pass the ratio test. None where there are too few.
    """
    sift = cv2.SIFT.create(FEATURES, contrastThreshold=MIN_CONTRAST)
    (points_a, a), (points_b, b) = (_described(sift, image) for image in (first, second))
    if min(len(points_a), len(points_b)) < MIN_MATCHES:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(b, a)}
    pairs = [
        [best.queryIdx, best.trainIdx]
        for best, other in matcher.knnMatch(a, b, 2)
        if best.distance < MAX_RATIO * other.distance and back[best.trainIdx] == best.queryIdx
    ]
    if len(pairs) < MIN_MATCHES:
        return None
    i, j = np.array(pairs).T
    p = points_a[i]
    q = points_b[j]
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
    """Return the given flow between two encoded images, or one that starts from their features.

    The latter is measured if less than ``MIN_DENSE`` of the given flow is matched, and used if it
    matches more than half as much: a failed dense search agrees with itself, too.
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
    """Measure guided flows of pairs of images from a cold start: first to second, and back."""
    matches = operator.measure(first, second, fine=False)
    found = []
    for n, pair in enumerate(zip(first, second, strict=True)):
        there, back = (FlowMatch(m.pixels[n : n + 1], m.weight[n : n + 1]) for m in matches)
        found.append(guided_flow(grid, operator, *pair, there, back))
    return found


def spread_positions(
    grid: SampleGrid, points: Float[Tensor, "n 2"], moved: Float[Tensor, "n 2"]
) -> Float[Tensor, "p 2"]:
    """Interpolate the motion of points, which go to ``moved``, at the cells of an image."""
    cell, inside = grid.cells_of(points)
    cell = cell[inside]
    flow = (moved - points)[inside]
    total = torch.zeros(grid.size, 2).index_add_(0, cell, flow)
    count = torch.zeros(grid.size).index_add_(0, cell, torch.ones(len(cell)))
    mean = (total / count.clamp(min=1)[:, None]).to(grid.device)
    count = count.to(grid.device)
    return grid.pixels + grid_fields(grid).fill(mean.mT.contiguous(), count.expand(2, -1)).mT


def _matched(match: FlowMatch) -> float:
    """Return the fraction of matched cells of an edge."""
    return float((match.weight[0, :, 0] > 0).float().mean())


def _described(sift: cv2.SIFT, image: Float[Tensor, "h w"]) -> tuple[np.ndarray, np.ndarray]:
    """Detect an image's features; return their positions and descriptors."""
    grey = image.round().clamp(0, 255).byte().cpu().numpy()
    points, descriptors = sift.detectAndCompute(grey, None)
    pixels = np.array([p.pt for p in points], np.float32).reshape(-1, 2)
    return pixels, np.zeros((0, 128), np.float32) if descriptors is None else descriptors
