"""Estimation of a keyframe's dense depth and its confidence, before any disk is made of it."""

from collections.abc import Sequence

import numpy as np

from geogs.config import DepthConfig
from geogs.depth.confidence import depth_confidence
from geogs.depth.depth_view import DepthView, KeyframeDepth
from geogs.depth.edges import resolve_edges
from geogs.depth.evidence import choose_start, tracker_evidence
from geogs.depth.grid_completion import complete_inverse_depth
from geogs.depth.plane_sweep import plane_sweep, sweep_planes
from geogs.depth.refinement import colour_guide, refine_depth
from geogs.depth.sweep_neighbors import depth_range
from geogs.geometry.camera import Camera


def estimate_depth(
    reference: DepthView,
    neighbours: Sequence[DepthView],
    render: Camera,
    working: Camera,
    limits: tuple[float, float] | None = None,
    most_planes: int = DepthConfig.planes,
) -> KeyframeDepth:
    """Dense depth of a keyframe from the tracker's grid and from matching with its neighbours.

    Completion of the grid, plane sweep with semi-global matching around it, refinement of both on
    slanted patches, a calibrated confidence, and the sides of depth edges by colour. ``neighbours``
    are best chosen by ``select_sweep_neighbours``; without any, the completed grid is returned.
    ``limits`` are the nearest and farthest depth to search; by default the tracker's, widened.
    Deterministic; releases the interpreter lock, so that several keyframes can be estimated at once
    in threads.
    """
    completed = complete_inverse_depth(
        reference.inverse_depth, reference.information, reference.image
    )
    tracker = tracker_evidence(completed, working, render)
    if not neighbours:
        return KeyframeDepth(1.0 / tracker.inverse_depth, 0.5 * tracker.prior_weight)
    near, far = limits or depth_range(reference, neighbours, working)
    planes = sweep_planes(reference, neighbours, render, near, far, most_planes)
    sweep = plane_sweep(
        reference, neighbours, render, planes, tracker.inverse_depth, tracker.prior_weight
    )
    start = choose_start(tracker, sweep)
    guide = colour_guide(reference, render)
    refined = refine_depth(reference, neighbours, render, working, *start, tracker, guide)
    refined.inverse_depth = np.clip(refined.inverse_depth, 0.5 / far, 2.0 / near)
    confidence = depth_confidence(refined, sweep.margin, tracker)
    refined, confidence = resolve_edges(refined, confidence, guide, sweep)
    return KeyframeDepth(1.0 / refined.inverse_depth, confidence)
