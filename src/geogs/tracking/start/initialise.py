"""Start-up: poses and depths of the first keyframes from flow alone.

Identity poses with unit depth fall into mirrored minima, so the pose of one keyframe against the
first comes from the essential matrix, the others follow by PnP on flows chained from the first, and
dense bundle adjustment with re-measured flow polishes the whole.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from enum import Enum
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.bundle.device_choice import grid_fields
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.uncertainty.marginals import marginals
from geogs.config import TrackingConfig
from geogs.geometry.jumps import widened
from geogs.geometry.lie import se3_inverse
from geogs.tracking.graph.dynamic_cells import dynamic_fraction
from geogs.tracking.graph.frame_graph import HUBER, FrameGraph
from geogs.tracking.graph.proximity import RADIUS
from geogs.tracking.graph.rigid_parts import largest_part
from geogs.tracking.matching.photometric_check import (
    MIN_NCC,
    PhotometricCheck,
    correlation_at,
)
from geogs.tracking.matching.pnp import pnp
from geogs.tracking.matching.sparse_features import guided_flows
from geogs.tracking.matching.two_view import TwoView, best_two_view
from geogs.tracking.matching.two_view_rotation import fit_rotation, has_moved
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeSet

MIN_PARALLAX = 0.005
"""Motion that rotation does not explain, needed to try to start, of the long edge."""
GIVEN_ERROR, MODEL_ERROR = 0.007, 0.01
"""What focal length, lens and rows may be off by turns a rotation into parallax: deviation of a
match that the camera's model leaves, of how far it has moved. The first of a lens that was given; a
tenth of the deviation of a focal length is added, up to the second."""
MAX_DEVIATION, LAST_DEVIATION = 0.1, 0.2
"""The map is started when the best known depths of its first keyframes are known to this: relative
standard deviation by what matches and poses leave open. The second where nothing better will come
of these keyframes: they are about to be given up for others, or the video ends."""
LEAST_SEEN = 0.4
"""Fraction of the first keyframe's depths that a keyframe must see to be placed on them."""
ROUNDS, FORGIVING = 6, 2
"""Rounds of flow and adjustment; and those after which it shows whether depths are far too open:
later ones find them more open yet."""
FAR = 1.5
"""Times the allowed deviation of depths beyond which one more keyframe is not going to help."""
MOST_MOVING = 0.5
"""Fraction of all cells that may be held for moving: of more, the poses are those of what moves."""


class Attempt(Enum):
    """What came of trying to start."""

    STARTED = "started"
    FAILED = "failed"
    FAR_OFF = "far off"
    """Depths are so open that only many more keyframes may help."""
    APART = "apart"
    """No one structure holds the keyframes together."""


def initialise(
    graph: FrameGraph,
    config: TrackingConfig,
    flows: Sequence[FlowMatch],
    most_open: float,
) -> Attempt:
    """Estimate all keyframes of the graph from nothing but the flows from the first to the others.

    It fails if they show no parallax, or none that a rotation of the camera would not explain as
    well (:mod:`geogs.tracking.matching.two_view_rotation`), if matches and poses leave their depths
    open (to more than ``most_open``), if most of what is seen moves by them (``MOST_MOVING``), if
    no one structure holds all keyframes (:mod:`geogs.tracking.graph.rigid_parts`), or if the images
    of two that follow each other do not correlate where poses and depths put them (``MIN_NCC``).
    On success poses, depths and information are set, the first pose is the identity and the median
    depth over all keyframes is one unit.
    """
    segment = graph.keyframes
    camera = segment.grid.camera
    # Poses are guessed on the CPU.
    flows = [f.on_cpu() for f in flows]
    best = best_two_view(camera, flows, MIN_PARALLAX * camera.long_edge)
    deviation = segment.table.focal_deviation
    if best is None or not has_moved_surely(
        SampleGrid(camera), flows[best[0]], best[1].T_ji, deviation
    ):
        return Attempt.FAILED
    _place_all(graph, flows, best)
    if not _polish(graph, config.moving, range(FORGIVING)):
        return Attempt.FAILED
    if _depth_deviation(graph) > FAR * most_open:
        return Attempt.FAR_OFF
    return polished(graph, config, most_open)


def polished(graph: FrameGraph, config: TrackingConfig, most_open: float) -> Attempt:
    """Adjust keyframes whose poses and depths are known roughly, and say whether to start so."""
    if not _polish(graph, config.moving, range(FORGIVING, ROUNDS)):
        return Attempt.FAILED
    segment, deviation = graph.keyframes, _depth_deviation(graph)
    if deviation > FAR * most_open:
        return Attempt.FAR_OFF
    if not largest_part(segment, graph.edges).issuperset(segment.ids):
        return Attempt.APART
    if deviation > most_open or dynamic_fraction(segment) > MOST_MOVING:
        return Attempt.FAILED
    return Attempt.STARTED if _passes_photometric_check(graph) else Attempt.FAILED


def has_moved_surely(
    grid: SampleGrid, match: FlowMatch, T_ji: Float[Tensor, "4 4"], focal_deviation: float
) -> bool:
    """Whether a flow (one edge, on the CPU) speaks for a relative pose, not for a rotation alone,
    with matches as unsure as the camera's model leaves them, of which the focal length is known to
    a relative ``focal_deviation``; 0 where somebody said it.

    Guesses have no say: of a bare wall they agree with either, and each speaks for the simpler one.
    """
    sure, moved = match.only_sure(), (match.pixels - grid.pixels).norm(dim=-1, keepdim=True)
    error = min(GIVEN_ERROR + 0.1 * focal_deviation, MODEL_ERROR)
    weight = sure.weight / (1 + sure.weight * (error * moved).square())
    unsure = replace(sure, weight=weight)
    rotated = fit_rotation(grid, unsure)
    return rotated is None or has_moved(grid, unsure, rotated, T_ji)


def _place_all(graph: FrameGraph, flows: Sequence[FlowMatch], best: tuple[int, TwoView]) -> None:
    """Poses by PnP on the first keyframe's depth, depths by propagating it; flows on the CPU.

    Keyframes that no longer see it are placed on what the one before them was given.
    """
    segment = graph.keyframes
    chosen, view = best
    keyframes, fields = list(segment), grid_fields(segment.grid)
    first = keyframes[0]
    device, grid = segment.grid.device, SampleGrid(segment.grid.camera)
    for keyframe in keyframes:
        keyframe.moving = None  # what a failed attempt held for moving was judged by wrong poses
    if view.apart.any():
        held = [view.apart, *(_carried(grid, view.apart, match) for match in flows)]
        for keyframe, cells in zip(keyframes, held, strict=True):
            keyframe.moving = cells.to(device)
    first.T_cw, known = torch.eye(4, dtype=torch.float64), view.good
    first.information = known.float().to(device)
    first.inverse_depth = fields.fill(view.inverse_depth.to(device), first.information)
    depth = first.inverse_depth.cpu()
    for n, (keyframe, match) in enumerate(zip(keyframes[1:], flows, strict=True)):
        if n == chosen:
            keyframe.T_cw = view.T_ji
        else:
            good = known & match.sure()[0]
            T = None
            if float(good.sum()) > LEAST_SEEN * float(known.sum()):
                T = pnp(grid, depth, match.pixels[0], good)
            keyframe.T_cw = placed_after(graph, keyframes[n], keyframe) if T is None else T
        keyframe.inverse_depth, keyframe.information = fields.transfer(
            keyframe.T_cw, first.inverse_depth, first.information
        )


def _carried(grid: SampleGrid, cells: Bool[Tensor, "p"], match: FlowMatch) -> Bool[Tensor, "p"]:
    """Where some cells of the first view, and those around, lie in another; all on the CPU."""
    there, inside = grid.cells_of(match.pixels[0, cells & match.sure()[0]])
    found = torch.zeros(grid.size, dtype=torch.bool)
    found[there[inside]] = True
    return widened(found.view(grid.height, grid.width), 1).view(-1)


def placed_after(graph: FrameGraph, before: Keyframe, keyframe: Keyframe) -> Float[Tensor, "4 4"]:
    """Pose of a keyframe by PnP on the depth of the one before it, or that one's pose."""
    grid, pair = graph.keyframes.grid, [before.encoded, keyframe.encoded]
    ((match, _),) = guided_flows(grid, graph.operator, pair[:1], pair[1:])
    good = match.sure()[0]
    if before.moving is not None:
        good = good & ~before.moving
    T_rel = pnp(grid, before.inverse_depth, match.pixels[0], good)
    return before.T_cw if T_rel is None else T_rel.to(before.T_cw) @ before.T_cw


def _polish(graph: FrameGraph, moving: float, rounds: Iterable[int]) -> bool:
    """Rounds of flow and adjustment, from forgiving to strict; then without what moves."""
    segment, ids = graph.keyframes, graph.keyframes.ids
    near = [(a, b) for n, a in enumerate(ids) for b in ids[n + 1 : n + 1 + RADIUS]]
    for n in rounds:
        graph.measure(graph.stale(near, 0.25), fine=n >= FORGIVING)
        options = BundleOptions(iterations=4, huber=(30.0, 10.0, 3.0)[min(n, 2)])
        if graph.adjust(list(graph.edges), ids[1:], ids, options, bounded=True) is None:
            return False
        normalise(segment)
        if n >= FORGIVING:
            graph.update_dynamic(ids, moving)
    return True


def _depth_deviation(graph: FrameGraph) -> float:
    """Relative deviation of the best known depths, the poses being as open as they are: the median
    of the keyframes'."""
    ids = graph.keyframes.ids
    problem, _ = graph.problem(list(graph.edges), ids[1:], ids)
    found = marginals(graph.keyframes.grid, problem, BundleOptions(huber=HUBER))
    return float(found.depth_deviation.median())


def _passes_photometric_check(graph: FrameGraph) -> bool:
    """Whether the images of all neighbours in time agree at their poses."""
    keyframes, grey, found = graph.keyframes, graph.operator.grey, []
    pairs = list(pairwise(keyframes.ids))
    for (i, j), T_ji in zip(pairs, keyframes.relative_poses(pairs), strict=True):
        first, second = keyframes[i], keyframes[j]
        images = grey(first.encoded), grey(second.encoded)
        depth = first.inverse_depth, first.information
        found.append(correlation_at(keyframes.grid, *images, T_ji, *depth))
    checks = [PhotometricCheck.of(numbers) for numbers in torch.stack(found).cpu()]
    return all(check.passes(MIN_NCC, is_expected=False) for check in checks)


def normalise(segment: KeyframeSet) -> None:
    """Move the first pose to the identity and scale so that the median depth is one unit."""
    origin = se3_inverse(next(iter(segment)).T_cw)
    for keyframe in segment:
        keyframe.T_cw = keyframe.T_cw @ origin
    depths = torch.cat([s.inverse_depth[s.information > 0] for s in segment])
    if len(depths):
        segment.rescale(float(depths.median()))
