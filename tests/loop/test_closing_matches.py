"""The matches that close loops: whose they are, in which order, and whose depth they decide."""

import torch

from drifted_walk import CAMERA, COUNT, NOTHING, closer_of, true_pose, world
from geogs.config import LoopConfig
from geogs.geometry.lie import se3_inverse
from geogs.loop.closure import take_over_depths
from geogs.loop.constraints import closing_matches
from geogs.types import FlowMatch
from geogs.world.edges import MeasuredEdge
from geogs.world.loops import Loop
from keyframe_samples import Sample, segment_of


def segment():
    samples = []
    for n in range(5):
        image = torch.full((48, 64, 3), 20 * n, dtype=torch.uint8).numpy()
        d = torch.full((6, 8), 0.5 + 0.1 * n)
        samples.append(Sample(n, image, torch.eye(4, dtype=torch.float64), d, torch.ones_like(d)))
    return segment_of(samples, CAMERA)


def flow(value: float, cells: int) -> FlowMatch:
    return FlowMatch(torch.full((1, cells, 2), value), torch.full((1, cells, 2), value + 1))


def edge(value: float, cells: int) -> MeasuredEdge:
    one = flow(value, cells)
    return MeasuredEdge(one.pixels[0], one.weight[0], one.pixels[0])


def test_edges_and_loops_come_by_source_and_the_graph_wins():
    keyframes = segment()
    ids, cells = keyframes.ids, keyframes.grid.size
    pose = torch.eye(4, dtype=torch.float64)
    known = {"cause": "geometry", "T_ji": pose, "scale": 1.0, "inliers": 0, "matched": 1.0}
    loops = [
        Loop(ids[0], ids[4], there=flow(1.0, cells), back=flow(2.0, cells), **known),
        Loop(ids[2], ids[3], there=flow(3.0, cells), back=flow(4.0, cells), **known),
        Loop(ids[1], 99, there=flow(5.0, cells), back=flow(6.0, cells), **known),
    ]
    edges = {(ids[3], ids[2]): edge(7.0, cells), (ids[2], ids[3]): edge(8.0, cells)}
    matches = closing_matches(keyframes, edges, loops)
    assert matches is not None
    pairs = list(zip(matches.source.tolist(), matches.target.tolist(), strict=True))
    assert pairs == [(0, 4), (2, 3), (3, 2), (4, 0)]
    assert matches.pixels[:, 0, 0].tolist() == [1.0, 8.0, 7.0, 2.0]
    assert torch.equal(matches.weight, matches.pixels + 1)
    assert torch.equal(matches.inverse_depth, keyframes.inverse_depths(ids))
    assert closing_matches(keyframes, {}, loops[2:]) is None


def test_depths_of_the_frame_graph_alone_are_taken_over():
    keyframes = segment()
    ids, cells = keyframes.ids, keyframes.grid.size
    before = keyframes.inverse_depths(ids).clone()
    edges = {(ids[3], ids[2]): edge(7.0, cells), (ids[2], ids[3]): edge(8.0, cells)}
    take_over_depths(keyframes, edges, dict(zip(ids, 2 * before, strict=True)))
    after = keyframes.inverse_depths(ids)
    assert torch.equal(after[[2, 3]], 2 * before[[2, 3]])
    assert torch.equal(after[[0, 1, 4]], before[[0, 1, 4]])


def closed(matches: bool) -> float:
    """Mean error of the relative translations of neighbours after the loop was closed."""
    tracker, loop = world(drift=0.06)
    closer = closer_of(tracker, loop, LoopConfig(matches=matches, residual=0.0, min_change=0.0))
    closer.update(NOTHING, is_last=True)
    assert closer.table.closures == 1
    keyframes, error = tracker.keyframes, 0.0
    for i in range(COUNT - 1):
        now = keyframes[i + 1].T_cw @ se3_inverse(keyframes[i].T_cw)
        true = true_pose(i + 1) @ se3_inverse(true_pose(i))
        error += float((now - true)[:3, 3].norm())
    assert all(bool(torch.isfinite(k.inverse_depth).all()) for k in keyframes)
    return error / (COUNT - 1)


def test_closing_with_matches_finds_what_relative_poses_cannot_know() -> None:
    """The odometry is the drift itself; only the flow between neighbours knows better."""
    assert closed(matches=True) < 0.75 * closed(matches=False)
