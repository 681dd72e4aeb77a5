"""Start-up: poses and depths of the first keyframes from flow alone.

Identity poses with unit depth would converge to mirrored minima. So the pose of one keyframe
relative to the first comes from the essential matrix, the others follow by PnP on flows chained
from the first, and dense bundle adjustment with re-measured flow refines all.
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
from geogs.tracking.matching.photometric_check import MIN_NCC, PhotometricCheck, correlation_at
from geogs.tracking.matching.pnp import pnp
from geogs.tracking.matching.sparse_features import guided_flows
from geogs.tracking.matching.two_view import TwoView, best_two_view
from geogs.tracking.matching.two_view_rotation import fit_rotation, has_moved
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeSet

MIN_PARALLAX = 0.005
"""Least motion not explained by rotation for a start, as a fraction of the long edge."""
GIVEN_ERROR, MODEL_ERROR = 0.007, 0.01
"""Deviation of a match due to errors of focal length, lens and rows, as a fraction of its motion;
such errors turn a rotation into parallax. The first for a given lens; a tenth of the deviation of a
focal length is added, up to the second."""
MAX_DEVIATION, LAST_DEVIATION = 0.1, 0.2
"""Relative standard deviation of the best known depths of the first keyframes below which the map
is started, by matches and poses. The second if these keyframes are about to be dropped for others,
or the video ends."""
LEAST_SEEN = 0.4
"""Fraction of the first keyframe's depths that a keyframe must see for PnP on them."""
ROUNDS, FORGIVING = 6, 2
"""Rounds of flow and adjustment; and those after which depths are tested for far too large
deviations, which grow in later rounds."""
FAR = 1.5
"""Ratio to the allowed deviation of depths beyond which one more keyframe is not going to help."""
MOST_MOVING = 0.5
"""Largest fraction of cells marked as moving: with more, poses follow the moving objects."""


class Attempt(Enum):
    """Outcome of an attempt to start."""

    STARTED = "started"
    FAILED = "failed"
    FAR_OFF = "far off"
    """Depths are so uncertain that only many more keyframes may help."""
    APART = "apart"
    """The keyframes are not all rigidly connected."""


def initialise(
    graph: FrameGraph, config: TrackingConfig, flows: Sequence[FlowMatch], most_open: float
) -> Attempt:
    """Estimate all keyframes of the graph from the flows from the first to the others alone.

    It fails if they show no parallax, or only what a rotation explains as well
    (:mod:`geogs.tracking.matching.two_view_rotation`), if the deviation of depths is larger than
    ``most_open``, if most cells move (``MOST_MOVING``), if not all keyframes are rigidly connected
    (:mod:`geogs.tracking.graph.rigid_parts`), or if images of consecutive keyframes do not
    correlate by their poses and depths (``MIN_NCC``).
    On success poses, depths and information are set, the first pose is the identity and the median
    depth over all keyframes is one unit.
    """
    segment = graph.keyframes
    camera = segment.grid.camera
    # Initial poses are computed on the CPU.
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
    """Adjust keyframes with approximate poses and depths, and decide whether to start."""
    if not _polish(graph, config.moving, range(FORGIVING, ROUNDS)):
        return Attempt.FAILED
    segment = graph.keyframes
    deviation = _depth_deviation(graph)
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
    """Whether a flow (one edge, on the CPU) supports a relative pose rather than a rotation alone.

    Deviations of matches include errors of the camera model; the focal length has a relative
    ``focal_deviation``, 0 where it was given. Only confident cells count: guesses on a bare wall
    agree with both, and each would support the simpler model.
    """
    sure = match.only_sure()
    moved = (match.pixels - grid.pixels).norm(dim=-1, keepdim=True)
    error = min(GIVEN_ERROR + 0.1 * focal_deviation, MODEL_ERROR)
    weight = sure.weight / (1 + sure.weight * (error * moved).square())
    unsure = replace(sure, weight=weight)
    rotated = fit_rotation(grid, unsure)
    return rotated is None or has_moved(grid, unsure, rotated, T_ji)


def _place_all(graph: FrameGraph, flows: Sequence[FlowMatch], best: tuple[int, TwoView]) -> None:
    """Set poses by PnP on the first keyframe's depth, and depths by propagating it; flows on CPU.

    Keyframes that no longer see it are located by the depth of the one before.
    """
    segment = graph.keyframes
    chosen, view = best
    keyframes = list(segment)
    fields = grid_fields(segment.grid)
    first = keyframes[0]
    device = segment.grid.device
    grid = SampleGrid(segment.grid.camera)
    for keyframe in keyframes:
        keyframe.moving = None  # a failed attempt marked moving cells by wrong poses
    if view.apart.any():
        held = [view.apart, *(_carried(grid, view.apart, match) for match in flows)]
        for keyframe, cells in zip(keyframes, held, strict=True):
            keyframe.moving = cells.to(device)
    first.T_cw = torch.eye(4, dtype=torch.float64)
    known = view.good
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
    """Propagate some cells of the first view, dilated by one, to another view; all on the CPU."""
    there, inside = grid.cells_of(match.pixels[0, cells & match.sure()[0]])
    found = torch.zeros(grid.size, dtype=torch.bool)
    found[there[inside]] = True
    return widened(found.view(grid.height, grid.width), 1).view(-1)


def placed_after(graph: FrameGraph, before: Keyframe, keyframe: Keyframe) -> Float[Tensor, "4 4"]:
    """Estimate a pose by PnP on the depth of the keyframe before, or return that one's pose."""
    grid = graph.keyframes.grid
    pair = [before.encoded, keyframe.encoded]
    ((match, _),) = guided_flows(grid, graph.operator, pair[:1], pair[1:])
    good = match.sure()[0]
    if before.moving is not None:
        good = good & ~before.moving
    T_rel = pnp(grid, before.inverse_depth, match.pixels[0], good)
    return before.T_cw if T_rel is None else T_rel.to(before.T_cw) @ before.T_cw


def _polish(graph: FrameGraph, moving: float, rounds: Iterable[int]) -> bool:
    """Run rounds of flow and adjustment, from tolerant to strict, then without moving cells."""
    segment = graph.keyframes
    ids = graph.keyframes.ids
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
    """Return the relative deviation of the best known depths, including errors of the poses: the
    median over the keyframes."""
    ids = graph.keyframes.ids
    problem, _ = graph.problem(list(graph.edges), ids[1:], ids)
    found = marginals(graph.keyframes.grid, problem, BundleOptions(huber=HUBER))
    return float(found.depth_deviation.median())


def _passes_photometric_check(graph: FrameGraph) -> bool:
    """Whether all consecutive keyframes pass the photometric check."""
    keyframes = graph.keyframes
    grey = graph.operator.grey
    found = []
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
