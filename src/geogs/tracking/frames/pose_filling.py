"""Pose of every frame relative to the present keyframes, from its stored sparse flow."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.device_choice import motion_solver
from geogs.bundle.problem import MotionProblem
from geogs.bundle.projection import linearise
from geogs.geometry.lie import se3_inverse
from geogs.tracking.frames.frame_recorder import pose_of, sparse_cells
from geogs.tracking.frames.interpolation import bridged
from geogs.tracking.frames.rotation_averaging import orientations
from geogs.tracking.frames.row_errors import LONGEST_INTERVAL, RowErrors, in_parts
from geogs.types import Trajectory
from geogs.world.edges import in_steps, unpacked_positions
from geogs.world.frames import FrameLog, FrameRecord, Observation
from geogs.world.keyframes import KeyframeSet

ITERATIONS = 8
"""Steps of the motion-only adjustment of a frame."""
HUBER = 3.0
"""Huber threshold of a frame's matches, in deviations."""


def solve_trajectory(
    frames: FrameLog,
    keyframes: KeyframeSet,
    elsewhere: Sequence[FrameRecord] = (),
    has_map: bool = True,
) -> Trajectory:
    """Solve the poses of all frames so far on the present keyframes, real timestamps.

    Positions of untracked frames, and of those ``elsewhere`` on keyframes of other segments, are
    interpolated between their neighbours; their orientations come from relative rotations, or are
    interpolated, too. Without a map (``has_map``) only rotations are known.
    """
    records = sorted([*frames.records, *elsewhere], key=lambda r: r.index)
    solved = solved_poses(frames, keyframes) if has_map else {}
    oriented = orientations(
        {r.index: r.rotations for r in records}, {n: T[:3, :3] for n, T in solved.items()}
    )
    timestamps = np.array([r.timestamp for r in records], dtype=np.float64)
    return bridged(
        timestamps, [solved.get(r.index) for r in records], [oriented.get(r.index) for r in records]
    )


def solved_poses(frames: FrameLog, keyframes: KeyframeSet) -> dict[int, Float[Tensor, "4 4"]]:
    """Solve world to camera of the located frames, by their indices."""
    tracked = tracked_on(frames, keyframes)
    solved = {r.index: pose_of(r, keyframes) for r in tracked}
    solver = motion_solver(keyframes.grid, sparse_cells(keyframes.grid))
    for part, problem in observed(tracked, keyframes):
        poses, _ = solver.solve(problem, iterations=ITERATIONS, huber=HUBER)
        solved.update({r.index: T for r, T in zip(part, poses, strict=True)})
    return solved


def row_errors(
    frames: FrameLog, keyframes: KeyframeSet, longest_interval: float = LONGEST_INTERVAL
) -> RowErrors | None:
    """Return the errors of rectified rows at the present state; None where no rows are rectified.
    Frames farther apart than ``longest_interval`` seconds have none."""
    if not frames.rows:
        return None
    indices = sorted(record.index for record in frames.records)
    trajectory = solve_trajectory(frames, keyframes)
    errors = RowErrors(keyframes.grid, frames.rows, indices, trajectory, longest_interval)
    return errors.with_lenses(frames.lenses)


def rows_in_doubt(
    frames: FrameLog, keyframes: KeyframeSet, known: RowErrors | None = None
) -> RowErrors | None:
    """Return the row errors (``known`` if already solved) where the readout is estimated, or
    unknown so that rows were not rectified; None where it was given. Frames may be any interval
    apart: poses then still give the effect of a readout error, if not the rows' true motion."""
    if frames.open_rows is None:
        if not any(rows.doubt for rows in frames.rows.values()):
            return None
        is_known = known is not None and known.doubt > 0
        errors = known if is_known else row_errors(frames, keyframes, math.inf)
    else:
        every = dict.fromkeys((record.index for record in frames.records), frames.open_rows)
        errors = row_errors(replace(frames, rows=every), keyframes, math.inf)
        errors = None if errors is None else errors.with_readout(0.0)
    return errors if errors is not None and errors.doubt > 0 else None


def shift_rows(frames: FrameLog, keyframes: KeyframeSet, errors: RowErrors) -> None:
    """Store the correction of the frames' matches for the row errors of both images."""
    grid = keyframes.grid
    cells = sparse_cells(grid)
    for part, ids in seen_by_keyframes(frames, keyframes):
        seen = [record.index for record, _ in part]
        shifts = errors.of_matches(
            [keyframes[k].frame_index for k in ids],
            seen,
            errors.poses(seen) @ se3_inverse(keyframes.poses(ids)),
            grid.rays[cells],
            keyframes.inverse_depths(ids)[:, cells],
            unpacked_positions(grid, torch.stack([o.of_one_lens for _, o in part])),
        )
        steps = in_steps(grid.camera, shifts.shift)
        for (_, observation), step in zip(part, steps, strict=True):
            observation.shift = step


def seen_by_keyframes(
    frames: FrameLog, keyframes: KeyframeSet
) -> Iterator[tuple[list[tuple[FrameRecord, Observation]], list[int]]]:
    """Yield the observations of located frames from keyframes, and the ids of these, in parts."""
    tracked = tracked_on(frames, keyframes)
    seen = [(r, o) for r in tracked for o in r.observations if o.keyframe in keyframes]
    for part in in_parts(seen, keyframes.grid.on_gpu):
        yield part, [o.keyframe for _, o in part]


def tracked_on(frames: FrameLog, keyframes: KeyframeSet) -> list[FrameRecord]:
    """Return the frames that have a pose relative to one of the keyframes, including these."""
    return [r for r in frames.records if r.anchor is not None and r.anchor in keyframes]


def observed(
    tracked: Sequence[FrameRecord], keyframes: KeyframeSet
) -> Iterator[tuple[list[FrameRecord], MotionProblem]]:
    """Yield the frames between keyframes that have matches, in parts, at their last poses.

    Matches are those of :func:`~geogs.tracking.frames.frame_recorder.sparse_cells`; their weights
    include the depth variance of the cells.
    """
    grid = keyframes.grid
    cells = sparse_cells(grid)
    are_keyframes = {s.frame_index for s in keyframes}
    seen = [
        r
        for r in tracked
        if r.index not in are_keyframes and any(o.keyframe in keyframes for o in r.observations)
    ]
    for part in in_parts(seen, grid.on_gpu):
        pairs = [
            (n, o) for n, r in enumerate(part) for o in r.observations if o.keyframe in keyframes
        ]
        start = torch.stack([pose_of(r, keyframes) for r in part])
        ids = [o.keyframe for _, o in pairs]
        frame = torch.tensor([n for n, _ in pairs])
        depth = keyframes.inverse_depths(ids)[:, cells]
        source = keyframes.poses(ids)
        p = linearise(grid.camera, grid.rays[cells], start[frame] @ se3_inverse(source), depth)
        weight = depth_aware_weight(
            torch.stack([o.half_weight for _, o in pairs]).float(),
            p.depth_jacobian,
            keyframes.informations(ids)[:, cells],
        )
        pixels = unpacked_positions(grid, torch.stack([o.shifted for _, o in pairs]))
        yield part, MotionProblem(start, depth, source, frame, pixels, weight)


def depth_aware_weight(
    weight: Float[Tensor, "e p 2"],
    depth_jacobian: Float[Tensor, "e p 2"],
    information: Float[Tensor, "e p"],
) -> Float[Tensor, "e p 2"]:
    """Return the inverse of a match's variance plus that of its depth propagated into the image."""
    depth = depth_jacobian.square() / information.clamp(min=1e-12)[..., None]
    variance = 1 / weight.clamp(min=1e-12) + depth
    return (weight > 0) * (information > 0)[..., None] / variance
