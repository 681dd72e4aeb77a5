"""Metric scale of a map: from odometry poses, a depth sensor, or a known length."""

from dataclasses import replace

import torch

from geogs.tracking.tracker import Tracker
from geogs.types import MetricScale
from geogs.world.keyframes import KeyframeSet
from geogs.world.world import World


def rescale(world: World, keyframes: KeyframeSet, scale: MetricScale) -> None:
    """Scale all lengths of the main map's poses and depths; disks follow the correction."""
    shrunk = torch.eye(4, dtype=torch.float64)
    shrunk[:3, :3] /= scale.factor
    keyframes.correct(keyframes.moved(shrunk))
    known = world.uncertainty
    if known is not None:
        world.uncertainty = replace(known, position=scale.factor * known.position)
    world.metric_scale = scale


def scale_by_odometry(main: Tracker) -> MetricScale | None:
    """Return the scale from odometry poses; None without, or in the gauge of a saved map."""
    odometry = main.map.odometry
    found = odometry.found
    if found.scale is None or main.segment.fixed:
        return None
    drift = (odometry.config.drift**2 + found.deviation**2) ** 0.5
    scale, found.scale = found.scale, 1.0
    return MetricScale("poses beside the images", scale, drift)
