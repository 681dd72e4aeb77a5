"""Standard deviations of frames: from the keyframes around them, and from their own matches."""

import math
from dataclasses import replace

import numpy as np
import torch

from geogs.bundle.device_choice import motion_solver
from geogs.bundle.flow_term import normal_equations, residual_norms, weighed_residuals
from geogs.bundle.projection import linearise
from geogs.geometry.lie import se3_inverse
from geogs.tracking.frames.frame_recorder import sparse_cells
from geogs.tracking.frames.pose_filling import HUBER, ITERATIONS, observed, row_errors, tracked_on
from geogs.tracking.keyframe_uncertainty import keyframe_uncertainty
from geogs.tracking.locate.pose_deviation import PoseDeviation, left_open
from geogs.tracking.row_twists import row_twists
from geogs.tracking.tracker import Tracker
from geogs.types import Uncertainty
from geogs.world.frames import FrameLog
from geogs.world.keyframes import KeyframeSet

EXPECTED_RESIDUAL = math.sqrt(2 * math.log(2))
"""Median length of a two-dimensional error, in standard deviations per axis."""
CAUTION = 4 / 3
"""Ratio of actual to predicted errors of frames between keyframes: the errors of a frame's matches
are correlated. Measured on rendered videos (docs/notebook/uncertainty.md has the table)."""


def frame_uncertainty(tracker: Tracker) -> Uncertainty:
    """Return deviations of all tracked frames of a tracker that has a map, by its present edges.

    The error of a frame between keyframes is that of the keyframes (deviations interpolated in
    time) plus that of its own few matches (:func:`own_deviations`). Every frame also has the error
    of the camera's unknown motion during readout (:func:`row_twists`). All are independent. Depths
    are those of the keyframes around.
    """
    log = tracker.map.recorder.log
    keyframes = tracker.keyframes
    tracked = sorted(tracked_on(log, keyframes), key=lambda r: r.index)
    times = np.array([r.timestamp for r in tracked], np.float64)
    errors = row_errors(log, keyframes)
    edges = tracker.map.graph.edges
    around = keyframe_uncertainty(tracker, errors).at(times)
    none = PoseDeviation(0.0, 0.0)
    unknown = PoseDeviation(np.inf, np.inf)
    known = dict.fromkeys((k.frame_index for k in keyframes), none)
    known |= own_deviations(log, keyframes)
    twists = None if errors is None else row_twists(errors, keyframes, edges, log, True)
    read = {} if twists is None else dict(zip(twists.frames, twists.leaves_open, strict=True))
    own = [(known.get(r.index, unknown), read.get(r.index, none)) for r in tracked]
    position = np.array([math.hypot(*(d.position for d in both)) for both in own], np.float64)
    rotation = np.array([math.hypot(*(d.rotation for d in both)) for both in own], np.float64)
    return replace(
        around,
        position=np.hypot(around.position, position),
        rotation=np.hypot(around.rotation, rotation),
    )


def own_deviations(frames: FrameLog, keyframes: KeyframeSet) -> dict[int, PoseDeviation]:
    """Return deviations of frames between keyframes relative to these, by frame index.

    They follow from the frame's normal equations at its solution (:func:`left_open`), times the
    frame's median residual over the expected one, and times ``CAUTION``. Frames without matches are
    left out. Source: the variance factor a posteriori of least squares, by a median for robustness.
    """
    grid = keyframes.grid
    found = dict[int, PoseDeviation]()
    cells = sparse_cells(grid)
    solver = motion_solver(grid, cells)
    for part, problem in observed(tracked_on(frames, keyframes), keyframes):
        T, _ = solver.solve(problem, iterations=ITERATIONS, huber=HUBER)
        T_ji = T[problem.frame] @ se3_inverse(problem.T_source)
        p = linearise(grid.camera, grid.rays[cells], T_ji, problem.inverse_depth)
        r, w = weighed_residuals(p, problem.pixels, problem.weight, HUBER)
        H, _ = normal_equations(p.pose_jacobian * w.mT[:, None], p.pose_jacobian, r)
        total = torch.zeros(len(part), 6, 6, dtype=H.dtype)
        total.index_add_(0, problem.frame, H.cpu())
        norm = residual_norms(p, problem.pixels, problem.weight).cpu()
        used = (p.valid & (problem.weight[..., 0] > 0)).cpu()
        for n, record in enumerate(part):
            edges = problem.frame == n
            if bool(used[edges].any()):
                factor = CAUTION * float(norm[edges][used[edges]].median())
                factor /= EXPECTED_RESIDUAL
                open_ = left_open(total[n])
                found[record.index] = PoseDeviation(
                    factor * open_.position, factor * open_.rotation
                )
    return found
