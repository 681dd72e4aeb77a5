"""A walk there and back whose poses have drifted, with exact matches, and the loop of its ends."""

from types import SimpleNamespace

import torch

from geogs.bundle.projection import project
from geogs.config import Config, LoopConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.loop.closer import LoopCloser
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.segment_trackers import Segments
from geogs.tracking.tracker import Tracker, TrackResult
from geogs.types import FlowMatch
from geogs.world.edges import MeasuredEdge
from geogs.world.loops import Loop
from geogs.world.segments import SegmentTable, TrackState, VideoSegment
from keyframe_samples import Sample, segment_of

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
NOTHING = TrackResult(TrackState.TRACKING)
"""Result of a frame that changes nothing."""
COUNT = 8


def true_pose(n: int) -> torch.Tensor:
    """World to camera of a walk to the right and back, a little beside the way there."""
    T = torch.eye(4, dtype=torch.float64)
    T[0, 3] = -0.15 * min(n, COUNT - 1 - n)
    T[1, 3] = -0.05 * (n >= COUNT // 2)
    return T


def exact_flow(grid, inverse_depth, T_ji) -> tuple[torch.Tensor, torch.Tensor]:
    seen = project(grid.camera, grid.rays, T_ji[None], inverse_depth[None])
    return seen.pixels[0].float(), torch.full((grid.size, 2), 25.0)


def world(drift: float):
    """A segment whose poses have drifted, with its exact edges, and the loop of its two ends."""
    g = torch.Generator().manual_seed(2)
    samples = []
    for n in range(COUNT):
        image = torch.zeros(48, 64, 3, dtype=torch.uint8).numpy()
        d = 0.3 + 0.5 * torch.rand(6, 8, generator=g)
        T = true_pose(n)
        T[:2, 3] *= 1 + drift * n
        samples.append(Sample(n, image, T, d, torch.full_like(d, 1e4)))
    keyframes = segment_of(samples, CAMERA)

    def flow_of(i: int, j: int) -> tuple[torch.Tensor, torch.Tensor]:
        T_ji = true_pose(j) @ se3_inverse(true_pose(i))
        return exact_flow(keyframes.grid, keyframes[i].inverse_depth, T_ji)

    edges = {}
    for i in range(COUNT - 1):
        for pair in ((i, i + 1), (i + 1, i)):
            pixels, weight = flow_of(*pair)
            edges[pair] = MeasuredEdge(pixels, weight, pixels)
    last = COUNT - 1
    ways = [FlowMatch(*(x[None] for x in flow_of(*pair))) for pair in ((0, last), (last, 0))]
    T_ji = true_pose(last) @ se3_inverse(true_pose(0))
    loop = Loop(0, last, "geometry", T_ji, 1.0, 0, 1.0, *ways)
    segment = VideoSegment(keyframes=keyframes, edges=edges)
    tracker = Tracker(segment, ClassicalFlow(keyframes.grid), Config())
    return tracker, loop


def closer_of(tracker: Tracker, loop: Loop, config: LoopConfig, waits: bool = True) -> LoopCloser:
    """What closes the loop, once it is asked to."""
    table, keyframes = SegmentTable([tracker.segment]), tracker.keyframes.table
    segments = Segments(table, keyframes, tracker.map.operator, Config())
    segments.main.map.graph.retire = lambda keep, least: {}
    closer = LoopCloser(segments, config, waits)
    closer.table.loops.append(loop)
    closer.detector = SimpleNamespace(update=lambda ids, is_last, settled: ())
    closer._take(loop)
    return closer
