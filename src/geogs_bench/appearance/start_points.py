"""Points to start the baseline from: SIFT features triangulated under the known poses."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from geogs.errors import InputError
from geogs.threads import thread_map
from geogs_bench.appearance.features import (
    FeatureMatches,
    ImageFeatures,
    epipolar_distance,
    find_features,
    match_features,
    neighbour_pairs,
)
from geogs_bench.appearance.triangulation import (
    Observations,
    Projections,
    largest_parallax,
    triangulate,
)
from geogs_bench.appearance.views import TrainingView

_PASSES = 3

Progress = Callable[[str, float], None]
"""Called with the name of a stage and its finished fraction."""


@dataclass(frozen=True)
class StartPointConfig:
    """How features become points."""

    features: int = 8192
    """Most features of an image."""
    neighbours: int = 14
    """Images that each one is matched with."""
    ratio: float = 0.8
    """A match must be nearer than this part of the second nearest."""
    max_epipolar: float = 2.0
    """Largest distance of a match from the epipolar line, pixels."""
    max_error: float = 2.0
    """Largest reprojection error, pixels."""
    min_parallax: float = 1.5
    """Least angle between two of a point's rays, degrees."""
    min_views: int = 2
    """Fewest images of a point."""


@dataclass(frozen=True)
class StartPoints:
    """Where the scene is, about."""

    positions: Float64[np.ndarray, "n 3"]
    """World frame."""
    colours: UInt8[np.ndarray, "n 3"]
    """RGB."""

    def __len__(self) -> int:
        return len(self.positions)


def find_start_points(
    views: list[TrainingView],
    config: StartPointConfig | None = None,
    progress: Progress = lambda stage, fraction: None,
) -> StartPoints:
    """Features, matches, tracks, triangulation; cut to the visual hull where there are masks.

    Raises:
        InputError: no point comes out.
    """
    config = config or StartPointConfig()
    features = thread_map(
        lambda view: find_features(view, config.features),
        views,
        lambda fraction: progress("features", fraction),
    )
    matches = _matches(views, features, config, progress)
    seen = tracks(features, matches)
    projections = projections_of(views)
    positions, seen = robust_points(projections, seen, config)
    inside = in_visual_hull(views, positions)
    seen = seen.only(inside[seen.point])
    positions = positions[inside]
    if not len(positions):
        raise InputError(
            "No feature of the images could be triangulated under their poses; the images may "
            "have too little texture or overlap."
        )
    return StartPoints(positions, _colours(views, seen))


def projections_of(views: list[TrainingView]) -> Projections:
    """The cameras of all views."""
    cameras = [view.camera for view in views]
    intrinsics = np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras])
    return Projections(np.stack([view.T_cw for view in views]), intrinsics)


def tracks(features: list[ImageFeatures], matches: list[FeatureMatches]) -> Observations:
    """Features joined by matches, directly or through others, as observations of one point."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    start = np.concatenate([[0], np.cumsum([len(found) for found in features])])
    total = int(start[-1])
    edges = [match.rows + start[[match.first, match.second]] for match in matches]
    one, other = np.concatenate([np.zeros((0, 2), np.int64), *edges]).T
    graph = coo_matrix((np.ones(len(one)), (one, other)), (total, total))
    label = connected_components(graph, directed=False)[1]
    view = np.repeat(np.arange(len(features)), np.diff(start))
    pixel = np.concatenate([found.pixels for found in features])
    order = np.argsort(label, kind="stable")
    every = Observations(label[order].astype(np.int64), view[order], pixel[order])
    joined = np.bincount(every.point, minlength=1)[every.point] > 1
    return every.only(joined)


def robust_points(
    projections: Projections, seen: Observations, config: StartPointConfig
) -> tuple[Float64[np.ndarray, "n 3"], Observations]:
    """Triangulate, drop observations that do not fit, again; then points with too little left."""
    for _ in range(_PASSES):
        if not seen.points:
            return np.zeros((0, 3)), seen
        positions = triangulate(projections, seen, config.max_error)
        error = projections.errors(positions, seen)
        seen = seen.only(_enough((error < config.max_error) & _best_in_view(seen, error), seen,
                                 config.min_views))  # fmt: skip
    if not seen.points:
        return np.zeros((0, 3)), seen
    positions = triangulate(projections, seen, config.max_error)
    error = projections.errors(positions, seen)
    worst = np.zeros(seen.points)
    np.maximum.at(worst, seen.point, error)
    wide = largest_parallax(projections, positions, seen) > config.min_parallax
    good = wide & (worst < config.max_error) & np.isfinite(positions).all(1)
    return positions[good], seen.only(good[seen.point])


def in_visual_hull(
    views: list[TrainingView], points: Float64[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "n"]:
    """Points that no image with a mask shows outside it; unseen ones count as inside."""
    inside = np.ones(len(points), dtype=bool)
    for view in views:
        if view.mask is None:
            continue
        local = points @ view.T_cw[:3, :3].T + view.T_cw[:3, 3]
        z = np.where(local[:, 2] > 0, local[:, 2], 1.0)
        camera = view.camera
        u = np.rint(camera.fx * local[:, 0] / z + camera.cx).astype(np.int64)
        v = np.rint(camera.fy * local[:, 1] / z + camera.cy).astype(np.int64)
        shown = (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        inside[shown] &= view.mask[v[shown], u[shown]]
    return inside


def _matches(
    views: list[TrainingView],
    features: list[ImageFeatures],
    config: StartPointConfig,
    progress: Progress,
) -> list[FeatureMatches]:
    def match(pair: tuple[int, int]) -> FeatureMatches:
        i, j = pair
        rows = match_features(features[i], features[j], config.ratio)
        pixels = features[i].pixels[rows[:, 0]], features[j].pixels[rows[:, 1]]
        distance = epipolar_distance(views[i], views[j], *pixels)
        return FeatureMatches(i, j, rows[distance < config.max_epipolar])

    pairs = neighbour_pairs(views, config.neighbours)
    # Not in threads: the product of the descriptors has threads of its own.
    found = []
    for number, pair in enumerate(pairs):
        found.append(match(pair))
        progress("matches", (number + 1) / len(pairs))
    return found


def _best_in_view(seen: Observations, error: Float64[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
    """Whether an observation is the best that its image has of its point."""
    order = np.lexsort((error, seen.view, seen.point))
    point, view = seen.point[order], seen.view[order]
    first = np.ones(len(order), dtype=bool)
    first[1:] = (point[1:] != point[:-1]) | (view[1:] != view[:-1])
    best = np.zeros(len(order), dtype=bool)
    best[order] = first
    return best


def _enough(kept: Bool[np.ndarray, "m"], seen: Observations, least: int) -> Bool[np.ndarray, "m"]:
    """What is kept of the points that keep at least so many observations."""
    return kept & (np.bincount(seen.point, kept, seen.points) >= least)[seen.point]


def _colours(views: list[TrainingView], seen: Observations) -> UInt8[np.ndarray, "n 3"]:
    """Mean colour of the pixels that see each point."""
    colour = np.zeros((len(seen.point), 3))
    for number, view in enumerate(views):
        mine = seen.view == number
        u, v = np.rint(seen.pixel[mine]).astype(np.int64).T
        u, v = u.clip(0, view.camera.width - 1), v.clip(0, view.camera.height - 1)
        colour[mine] = view.image[v, u]
    count = np.bincount(seen.point, minlength=seen.points)
    total = [np.bincount(seen.point, channel, seen.points) for channel in colour.T]
    return np.rint(np.stack(total, 1) / count[:, None]).astype(np.uint8)
