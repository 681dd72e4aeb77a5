"""What a tracker says of how well it knows the frames between its keyframes."""

import numpy as np
import pytest
import torch

from geogs.bundle.uncertainty.marginals import ALIKE
from geogs.geometry.lie import retract, se3_inverse
from geogs.tracking.frame_uncertainty import (
    CAUTION,
    EXPECTED_RESIDUAL,
    frame_uncertainty,
    own_deviations,
)
from geogs.tracking.frames.frame_recorder import FrameRecorder, pose_of, sparse_cells
from geogs.tracking.frames.pose_filling import solve_trajectory
from geogs.tracking.keyframe_uncertainty import keyframe_uncertainty
from geogs.tracking.tracker import Tracker
from geogs.types import FlowMatch, Frame
from geogs.world.edges import unpacked_positions
from geogs.world.frames import FrameLog
from planted_walk import planted_tracker

TRUE_SIGMA = 0.2
"""Pixels by which matches of frames are off, along each axis."""


def seen(
    tracker: Tracker, T: torch.Tensor, of: int, keyframes: tuple[int, ...], said: float, seed: int
) -> FrameLog:
    """A frame where keyframe ``of`` was, matched from others; matches say ``said`` pixels."""
    log = FrameLog()
    recorder = FrameRecorder(log, tracker.keyframes, tracker.map.operator)
    noise = torch.Generator().manual_seed(seed)
    for k in keyframes:
        exact, _ = tracker.map.operator.measure([k], [of])
        pixels = exact.pixels + TRUE_SIGMA * torch.randn(exact.pixels.shape, generator=noise)
        match = FlowMatch(pixels, (exact.weight > 0) / said**2)
        if not log.records:
            frame = Frame(10 * of + 5, (of + 0.5) / 3, np.zeros((2, 2, 3), np.uint8))
            recorder.add(frame, None, k, T[of] @ se3_inverse(T[k]), match)
        else:
            recorder._observe([(log.records[0], k)], match)
    return log


def where(grid, ray, d, T):
    """Where one cell falls, written out."""
    y = T[:3, :3] @ ray.double() + float(d) * T[:3, 3]
    c = grid.camera
    return torch.stack([c.fx * y[0] / y[2] + c.cx, c.fy * y[1] / y[2] + c.cy])


def test_it_is_the_inverse_of_what_the_matches_say_one_by_one():
    tracker, T = planted_tracker(4, sigma=0.0)
    keyframes, grid = tracker.keyframes, tracker.keyframes.grid
    log = seen(tracker, T, 2, (1, 3), 0.5, seed=1)
    record, cells = log.records[0], sparse_cells(grid)
    start = pose_of(record, keyframes)
    T_found = se3_inverse(torch.from_numpy(solve_trajectory(log, keyframes).T_wc[0]))
    H, norms, step = torch.zeros(6, 6, dtype=torch.float64), [], 1e-6
    for o in record.observations:
        source = keyframes[o.keyframe]
        first, last = (x @ se3_inverse(source.T_cw) for x in (start, T_found))
        found = unpacked_positions(grid, o.position[None])[0]
        for n, cell in enumerate(cells.tolist()):
            said = float(o.half_weight[n, 0])
            if said == 0:
                continue
            ray, d = grid.rays[cell], source.inverse_depth[cell]
            by_depth = (where(grid, ray, d + step, first) - where(grid, ray, d - step, first)) / (
                2 * step
            )
            w = 1 / (1 / said + by_depth.square() / float(source.information[cell]))
            r = found[n] - where(grid, ray, d, last)
            norms.append(float((w * r.square()).sum().sqrt()))
            J = torch.zeros(2, 6, dtype=torch.float64)
            for k in range(6):
                xi = torch.zeros(6, dtype=torch.float64)
                xi[k] = step
                ahead, behind = (where(grid, ray, d, retract(s * xi, last)) for s in (1, -1))
                J[:, k] = (ahead - behind) / (2 * step)
            H += min(1.0, 3.0 / norms[-1]) * J.T @ (J * w[:, None])
    factor = CAUTION * float(np.median(norms)) / EXPECTED_RESIDUAL
    C = ALIKE * factor**2 * torch.linalg.inv(H)
    deviation = own_deviations(log, keyframes)[25]
    assert deviation.position == pytest.approx(float(C.diagonal()[:3].sum().sqrt()), rel=0.02)
    assert deviation.rotation == pytest.approx(float(C.diagonal()[3:].sum().sqrt()), rel=0.02)


def test_what_is_said_is_what_errors_are_whatever_the_matches_say_of_themselves():
    tracker, T = planted_tracker(4, sigma=0.0)
    tracker.keyframes[1].information *= 1e4
    for said in (0.1, 0.4):
        log = FrameLog()
        for seed in range(40):
            log.records.extend(seen(tracker, T, 2, (1,), said, seed).records)
            log.records[-1].index = seed + 10
        centres = torch.from_numpy(solve_trajectory(log, tracker.keyframes).T_wc)[:, :3, 3]
        errors = (centres - se3_inverse(T[2])[:3, 3]).norm(dim=1).numpy()
        deviations = [d.position for d in own_deviations(log, tracker.keyframes).values()]
        # Errors that are independent are foretold too large, by what errors of neighbours share.
        caution = CAUTION * ALIKE**0.5
        ratio = caution * np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(deviations)))
        assert ratio == pytest.approx(1.0, abs=0.25)


def test_a_frame_is_known_less_than_the_keyframes_around_it():
    tracker, T = planted_tracker(6)
    tracker.map.graph.measure([(a, b) for a in range(6) for b in range(a + 1, 6)])
    log = tracker.map.recorder.log
    for n, keyframe in enumerate(tracker.keyframes):
        keyframe.frame_index = 10 * n
        tracker.map.recorder.add_keyframe(keyframe)
    frame, blind = (seen(tracker, T, n, (1, 3), 0.5, seed=0).records[0] for n in (2, 3))
    blind.observations = []
    log.records[:] = sorted([*log.records, frame, blind], key=lambda r: r.index)
    known = keyframe_uncertainty(tracker)
    found = frame_uncertainty(tracker)
    own = own_deviations(log, tracker.keyframes)
    assert list(own) == [25]
    at_keyframes, at, in_the_dark = [0, 1, 2, 4, 6, 7], 3, 5
    assert found.position[at_keyframes] == pytest.approx(known.position)
    between = (known.position[2] + known.position[3]) / 2
    assert found.position[at] == pytest.approx(np.hypot(between, own[25].position))
    turned = (known.rotation[2] + known.rotation[3]) / 2
    assert found.rotation[at] == pytest.approx(np.hypot(turned, own[25].rotation))
    assert own[25].position > 0.1 * between
    assert found.position[in_the_dark] == found.rotation[in_the_dark] == np.inf
    assert found.depth[in_the_dark] == pytest.approx((known.depth[3] + known.depth[4]) / 2)
