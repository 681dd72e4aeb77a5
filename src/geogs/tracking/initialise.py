"""Start-up: poses and depths of the first keyframes from flow alone.

Identity poses with unit depth fall into mirrored minima, so the pose of one keyframe against the
first comes from the essential matrix, the others follow by PnP on flows chained from the first, and
dense bundle adjustment with re-measured flow polishes the whole.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from geogs.bundle.base import BundleOptions
from geogs.bundle.marginals import marginals
from geogs.bundle.select import grid_fields
from geogs.config import TrackingConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.threads import thread_map
from geogs.tracking.evidence import Evidence, correlation_at
from geogs.tracking.features import surer_flows
from geogs.tracking.graph import HUBER, FrameGraph
from geogs.tracking.motion import MIN_NCC, pnp
from geogs.tracking.proximity import RADIUS
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeSet

MIN_PARALLAX = 0.005
"""Motion that rotation does not explain, needed to try to start, of the long edge."""
MAX_DEVIATION = 0.2
"""The map is started when the depths of its first keyframes are known to this, in the median:
relative standard deviation by what matches and poses leave open."""
FARTHEST = 50.0
"""Baselines beyond which a point says nothing on which of four poses is the right one."""
LEAST_SEEN = 0.4
"""Share of the first keyframe's depths that a keyframe must see to be placed on them."""
ROUNDS, FORGIVING = 6, 2
"""Rounds of flow and adjustment; and those after which it shows whether depths are far too open:
later ones find them more open yet."""
FAR = 1.5
"""Times the allowed deviation of depths beyond which one more keyframe is not going to help."""


class Attempt(Enum):
    """What came of trying to start."""

    STARTED = "started"
    FAILED = "failed"
    FAR_OFF = "far off"
    """Depths are so open that only many more keyframes may help."""


@dataclass(frozen=True)
class TwoView:
    """The relative pose of a pair of views and the depth that it gives, up to scale; on the CPU."""

    T_ji: Float[Tensor, "4 4"]
    inverse_depth: Float[Tensor, "p"]
    """Of the first view, median 1; 1 where it is not good."""
    good: Bool[Tensor, "p"]
    parallax: float
    """Median motion in pixels that rotation does not explain."""


def initialise(graph: FrameGraph, config: TrackingConfig, flows: Sequence[FlowMatch]) -> Attempt:
    """Estimate all keyframes of the graph from nothing but the flows from the first to the others.

    It fails if they show no parallax, if matches and poses leave their depths open
    (``MAX_DEVIATION``), or if the images of two that follow each other do not correlate where
    poses and depths put them (``MIN_NCC``).
    On success poses, depths and information are set, the first pose is the identity and the median
    depth over all keyframes is one unit.
    """
    store = graph.keyframes
    camera = store.grid.camera
    min_parallax = MIN_PARALLAX * max(camera.width, camera.height)
    # Poses are guessed on the CPU.
    flows = [FlowMatch(f.pixels.cpu(), f.weight.cpu()) for f in flows]
    found = thread_map(lambda match: two_view(camera, match), flows)
    best = best_two_view(found, min_parallax)
    if best is None:
        return Attempt.FAILED
    _place_all(graph, flows, best)
    for rounds in (range(FORGIVING), range(FORGIVING, ROUNDS)):
        if not _polish(graph, config.moving, rounds):
            return Attempt.FAILED
        deviation = _depth_deviation(graph)
        if deviation > FAR * MAX_DEVIATION:
            return Attempt.FAR_OFF
    if deviation > MAX_DEVIATION or not _is_borne_out(graph):
        return Attempt.FAILED
    return Attempt.STARTED


def best_two_view(
    views: Iterable[TwoView | None], min_parallax: float
) -> tuple[int, TwoView] | None:
    """The pair to start from, with its place; None where none has the parallax (pixels)."""
    best, best_score = None, 0.0
    for n, view in enumerate(views):
        if view is None or view.parallax < min_parallax:
            continue
        # Parallax helps until the views no longer overlap.
        score = min(view.parallax, 3 * min_parallax) * int(view.good.sum())
        if score > best_score:
            best, best_score = (n, view), score
    return best


def two_view(camera: Camera, match: FlowMatch) -> TwoView | None:
    """Relative pose by the essential matrix and depth by triangulation, on the CPU."""
    found = relative_pose(camera, match)
    if found is None:
        return None
    T, inliers = found
    p, q = SampleGrid(camera).pixels.double().numpy(), match.pixels[0].double().numpy()
    K, count = camera.matrix().numpy(), len(p)
    homogeneous = cv2.triangulatePoints(K @ np.eye(3, 4), K @ T[:3], p[inliers].T, q[inliers].T)
    z = homogeneous[2] / np.where(np.abs(homogeneous[3]) < 1e-12, 1e-12, homogeneous[3])
    median = np.median(z[z > 0])
    near = (z > 0.1 * median) & (z < 10 * median)
    z, inliers = z[near], inliers[near]
    rotated = rays_through(p[inliers], K) @ (K @ T[:3, :3]).T
    parallax = np.median(np.linalg.norm(q[inliers] - rotated[:, :2] / rotated[:, 2:], axis=1))
    T[:3, 3] /= median
    depth, known = torch.ones(count), torch.zeros(count, dtype=torch.bool)
    depth[inliers], known[inliers] = torch.from_numpy(median / z).float(), True
    return TwoView(torch.from_numpy(T), depth, known, float(parallax))


def relative_pose(
    camera: Camera, match: FlowMatch
) -> tuple[Float64[np.ndarray, "4 4"], Int[np.ndarray, "n"]] | None:
    """First camera to second by the essential matrix (MAGSAC), and the cells that agree with it.

    The translation is a unit. None where too few cells are matched, or lie before both cameras.
    """
    used = match.sure()[0].numpy()
    if used.sum() < 0.1 * len(used):
        return None
    p, q = SampleGrid(camera).pixels.double().numpy(), match.pixels[0].double().numpy()
    K = camera.matrix().numpy()
    try:
        E, mask = cv2.findEssentialMat(p[used], q[used], K, cv2.USAC_MAGSAC, 0.9999, 0.7)
    except cv2.error:  # OpenCV 5 fails an assertion where no sample gives a model
        return None
    if E is None or E.shape != (3, 3):
        return None
    agreeing = np.flatnonzero(used)[mask[:, 0] > 0]
    R, t, in_front = _pose_of(E, rays_through(p[agreeing], K), rays_through(q[agreeing], K))
    if in_front.sum() < 0.3 * used.sum():
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T, agreeing[in_front]


def rays_through(
    pixels: Float64[np.ndarray, "n 2"], K: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Rays of z = 1 through the pixels of a camera with the matrix K."""
    return np.c_[(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(pixels))]


def _pose_of(
    E: Float64[np.ndarray, "3 3"],
    first: Float64[np.ndarray, "n 3"],
    second: Float64[np.ndarray, "n 3"],
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"], Bool[np.ndarray, "n"]]:
    """Of the four poses of an essential matrix the one that sees most points before both cameras.

    Returns the rotation, the unit translation (first camera to second) and which points lie there,
    nearer than ``FARTHEST`` baselines. From z R a + t = z' b for the rays a and b of a point its
    two depths follow by the cross products with b and with R a.
    """
    R1, R2, t = cv2.decomposeEssentialMat(E)
    t, best = t[:, 0], None
    for R in (R1, R2):
        turned = first @ R.T
        across = np.cross(turned, second)
        square = np.maximum((across**2).sum(1), 1e-30)
        z_first = -(np.cross(t, second) * across).sum(1) / square
        z_second = -(np.cross(t, turned) * across).sum(1) / square
        for sign in (1.0, -1.0):
            z, other = sign * z_first, sign * z_second
            seen = (z > 0) & (z < FARTHEST) & (other > 0) & (other < FARTHEST)
            if best is None or seen.sum() > best[2].sum():
                best = R, sign * t, seen
    assert best is not None
    return best


def _place_all(graph: FrameGraph, flows: Sequence[FlowMatch], best: tuple[int, TwoView]) -> None:
    """Poses by PnP on the first keyframe's depth, depths by carrying it over; flows on the CPU.

    Keyframes that no longer see it are placed on what the one before them was given.
    """
    store = graph.keyframes
    chosen, view = best
    states, fields = list(store), grid_fields(store.grid)
    first = states[0]
    device, grid = store.grid.device, SampleGrid(store.grid.camera)
    first.T_cw, known = torch.eye(4, dtype=torch.float64), view.good
    first.information = known.float().to(device)
    first.inverse_depth = fields.fill(view.inverse_depth.to(device), first.information)
    depth = first.inverse_depth.cpu()
    for n, (state, match) in enumerate(zip(states[1:], flows, strict=True)):
        if n == chosen:
            state.T_cw = view.T_ji
        else:
            good = known & match.sure()[0]
            T = None
            if float(good.sum()) > LEAST_SEEN * float(known.sum()):
                T = pnp(grid, depth, match.pixels[0], good)
            state.T_cw = placed_after(graph, states[n], state) if T is None else T
        state.inverse_depth, state.information = fields.transfer(
            state.T_cw, first.inverse_depth, first.information
        )


def placed_after(graph: FrameGraph, before: Keyframe, state: Keyframe) -> Float[Tensor, "4 4"]:
    """Pose of a keyframe by PnP on the depth of the one before it, or that one's pose."""
    grid, pair = graph.keyframes.grid, [before.encoded, state.encoded]
    ((match, _),) = surer_flows(grid, graph.operator, pair[:1], pair[1:])
    T_rel = pnp(grid, before.inverse_depth, match.pixels[0], match.sure()[0])
    return before.T_cw if T_rel is None else T_rel.to(before.T_cw) @ before.T_cw


def _polish(graph: FrameGraph, moving: float, rounds: Iterable[int]) -> bool:
    """Rounds of flow and adjustment, from forgiving to strict; then without what moves."""
    store, ids = graph.keyframes, graph.keyframes.ids
    near = [(a, b) for n, a in enumerate(ids) for b in ids[n + 1 : n + 1 + RADIUS]]
    for n in rounds:
        graph.measure(graph.stale(near, 0.25), fine=n >= FORGIVING)
        options = BundleOptions(iterations=4, huber=(30.0, 10.0, 3.0)[min(n, 2)])
        if graph.adjust(list(graph.edges), ids[1:], ids, options) is None:
            return False
        normalise(store)
        if n >= FORGIVING:
            graph.judge_moving(ids, moving)
    return True


def _depth_deviation(graph: FrameGraph) -> float:
    """Relative deviation of the depths, the poses being as open as they are: the median of all."""
    ids = graph.keyframes.ids
    problem, _ = graph.problem(list(graph.edges), ids[1:], ids)
    found = marginals(graph.keyframes.grid, problem, BundleOptions(huber=HUBER))
    return float(found.depth_deviation.median())


def _is_borne_out(graph: FrameGraph) -> bool:
    """Whether the images of all neighbours in time agree at their poses."""
    grey, found = graph.operator.grey, []
    for a, b in pairwise(graph.keyframes):
        found.append(
            correlation_at(
                graph.keyframes.grid,
                grey(a.encoded),
                grey(b.encoded),
                b.T_cw @ se3_inverse(a.T_cw),
                a.inverse_depth,
                a.information,
            )
        )
    evidence = map(Evidence.of, torch.stack(found).cpu())
    return all(e.bears_out(MIN_NCC, is_expected=False) for e in evidence)


def normalise(store: KeyframeSet) -> None:
    """Move the first pose to the identity and scale so that the median depth is one unit."""
    origin = se3_inverse(next(iter(store)).T_cw)
    for state in store:
        state.T_cw = state.T_cw @ origin
    depths = torch.cat([s.inverse_depth[s.information > 0] for s in store])
    if len(depths):
        store.rescale(float(depths.median()))
