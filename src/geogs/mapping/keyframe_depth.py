"""A dense depth, with a confidence, for a keyframe before any disk is made of it."""

from collections.abc import Sequence

from geogs.config import DepthConfig
from geogs.geometry.camera import Camera
from geogs.mapping.completion import complete_inverse_depth, upsample_grid
from geogs.mapping.depth_fusion import fuse, tracker_confidence
from geogs.mapping.depth_view import DepthView, KeyframeDepth
from geogs.mapping.plane_sweep import plane_sweep, sweep_planes
from geogs.mapping.sweep_neighbors import depth_range


def estimate_depth(
    reference: DepthView,
    neighbours: Sequence[DepthView],
    render: Camera,
    working: Camera,
    config: DepthConfig,
) -> KeyframeDepth:
    """Completion, plane sweep and their fusion."""
    completed = complete_inverse_depth(
        reference.inverse_depth, reference.information, reference.image, config
    )
    near, far = depth_range(reference, neighbours, working, config)
    planes = sweep_planes(reference, neighbours, render, near, far, config)
    prior = upsample_grid(completed.inverse_depth, working, render)
    sure = upsample_grid(tracker_confidence(completed.deviation, config), working, render)
    sweep = plane_sweep(reference, neighbours, render, planes, prior, sure, config)
    return fuse(completed, sweep, working, render, config)
