"""Velocity of the camera while it reads a frame, from the rows of the frame's own matches.

A polynomial through the poses around a frame assumes smooth motion between images. A camera that is
knocked has another velocity, its rows are sheared, and the pose follows the shear. But the matches
of the frame determine velocity and pose: the velocity moves each cell in proportion to the time of
its row.
"""

from collections.abc import Iterator, Mapping
from itertools import chain
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.bundle.flow_term import weighed_residuals
from geogs.bundle.projection import linearise
from geogs.geometry.lie import se3_inverse
from geogs.tracking.frames.frame_recorder import sparse_cells
from geogs.tracking.frames.pose_filling import HUBER, depth_aware_weight, seen_by_keyframes
from geogs.tracking.frames.row_errors import RowErrors, in_parts
from geogs.tracking.graph.dynamic_cells import static_weight
from geogs.tracking.locate.pose_deviation import PoseDeviation
from geogs.world.edges import Edge, Pair, edge_matches, unpacked_positions
from geogs.world.frames import FrameLog
from geogs.world.keyframes import KeyframeSet

EVIDENCE = 0.02
"""Weight of the matches' evidence on rows, as the errors of an edge are correlated."""


class _Matches(NamedTuple):
    """Matches that end in frames."""

    source: list[int]
    """Frames of the sources."""
    target: list[int]
    T_ji: Float[Tensor, "e 4 4"]
    rays: Float[Tensor, "p 3"]
    inverse_depth: Float[Tensor, "e p"]
    pixels: Float[Tensor, "e p 2"]
    information: Float[Tensor, "e p"]
    weight: Float[Tensor, "e p 2"]


class RowTwists(NamedTuple):
    """Twists of frames while they were read."""

    frames: list[int]
    twist: Float64[Tensor, "n 6"]
    """Twist per second, beyond that of the trajectory; a left perturbation of the frame's pose."""
    leaves_open: list[PoseDeviation]
    """Deviations of the frames' poses due to errors of the twists."""


def row_twists(
    errors: RowErrors,
    keyframes: KeyframeSet,
    edges: Mapping[Pair, Edge],
    log: FrameLog,
    are_corrected: bool = False,
) -> RowTwists:
    """Estimate twists of frames during readout, from the matches that end in them.

    Each is estimated together with a step of the frame's pose. Its prior deviation is the
    difference of two polynomials through the poses around (:meth:`RowErrors.twist_deviations`).
    Depths, and the poses of the source frames, are assumed exact.
    Source: pose and velocity from one image of a rolling shutter (Ait-Aider et al. 2006), with a
    prior on the velocity.

    Args:
        errors: row errors by the present trajectory, for the assumed readout.
        edges: matches between keyframes.
        log: frames, with their matches from keyframes.
        are_corrected: whether the matches are already corrected for the rows; if not, ``errors``
            correct them here.
    """
    frames, A = _summed(errors, keyframes, edges, log, are_corrected)
    return RowTwists(frames, *solved_twists(A, errors.twist_deviations(frames)))


def part_seen(
    errors: RowErrors,
    others: RowErrors,
    keyframes: KeyframeSet,
    edges: Mapping[Pair, Edge],
    log: FrameLog,
) -> float:
    """Fit the twists of frames on the line from those of ``errors`` (0) to those of ``others`` (1)
    to the matches, by least squares; 0 where they are not determined. Matches are not yet corrected
    for the rows."""
    frames, A = _summed(errors, keyframes, edges, log, False)
    way = (others.twists(frames) - errors.twists(frames))[..., None]
    _, S, g = _of_twists(A)
    square = float((way.mT @ S @ way).sum())
    return float((way * g).sum()) / square if square > 0 else 0.0


def _summed(
    errors: RowErrors,
    keyframes: KeyframeSet,
    edges: Mapping[Pair, Edge],
    log: FrameLog,
    are_corrected: bool,
) -> tuple[list[int], Float64[Tensor, "n 12 13"]]:
    """Return the target frames of the matches, and the normal equations of a step of each one's
    pose and twist, with right sides."""
    sums: dict[int, Float64[Tensor, "12 13"]] = {}
    for part in chain(  # some edges at a time, as their equations take memory
        _of_keyframes(keyframes, edges), _of_frames(errors, keyframes, log, are_corrected)
    ):
        if not are_corrected:
            found = errors.of_matches(
                part.source, part.target, part.T_ji, part.rays, part.inverse_depth, part.pixels
            )
            part = part._replace(pixels=part.pixels + found.shift)
        for frame, equations in zip(part.target, _equations(errors, keyframes, part), strict=True):
            sums[frame] = sums.get(frame, 0) + equations
    none = torch.zeros(0, 12, 13, dtype=torch.float64)
    return [*sums], torch.stack([*sums.values()]) if sums else none


def solved_twists(
    A: Float64[Tensor, "n 12 13"], deviation: Float64[Tensor, "n 6"]
) -> tuple[Float64[Tensor, "n 6"], list[PoseDeviation]]:
    """Solve for the most likely twists, and the resulting deviations of the poses, from the normal
    equations of poses and twists, weighted by ``EVIDENCE``, and the twists' prior deviations."""
    follow, S, g = _of_twists(EVIDENCE * A)
    eye = torch.eye(6, dtype=A.dtype)
    rows, columns = deviation[..., None], deviation[:, None]
    open_ = rows * torch.linalg.inv(rows * S * columns + eye) * columns
    squares = (follow @ open_ @ follow.mT).diagonal(dim1=1, dim2=2).reshape(-1, 2, 3).sum(2)
    left = [PoseDeviation(*two) for two in squares.clamp(min=0).sqrt().tolist()]
    return (open_ @ g)[..., 0], left


def _of_twists(
    A: Float64[Tensor, "n 12 13"],
) -> tuple[Float64[Tensor, "n 6 6"], Float64[Tensor, "n 6 6"], Float64[Tensor, "n 6 1"]]:
    """Eliminate poses: return their dependence on the twists, and the equations of the twists."""
    H = A[..., :12]
    v = A[..., 12:]
    of_pose = H[:, :6, :6]
    both = H[:, 6:, :6]
    of_twist = H[:, 6:, 6:]
    largest = of_pose.diagonal(dim1=1, dim2=2).amax(1).clamp(min=1e-9)
    damped = of_pose + 1e-9 * largest[:, None, None] * torch.eye(6, dtype=H.dtype)
    follow, step = torch.linalg.solve(damped, torch.cat([both.mT, v[:, :6]], 2)).split([6, 1], 2)
    return follow, of_twist - both @ follow, v[:, 6:] - both @ step


def _equations(
    errors: RowErrors, keyframes: KeyframeSet, m: _Matches
) -> Float64[Tensor, "e 12 13"]:
    """Return normal equations of each edge, for a step of the target's pose and its twist."""
    p = linearise(keyframes.grid.camera, m.rays, m.T_ji, m.inverse_depth)
    weight = depth_aware_weight(m.weight, p.depth_jacobian, m.information)
    r, w = weighed_residuals(p, m.pixels, weight, HUBER)
    seconds = errors.seconds(m.target, m.pixels)
    J = torch.cat([p.pose_jacobian, seconds[:, None, None] * p.pose_jacobian], 1).flatten(2)
    wJ = J * w.mT.flatten(1)[:, None]
    return (wJ @ torch.cat([J, r.mT.flatten(1)[:, None]], 1).mT).double().cpu()


def _of_keyframes(keyframes: KeyframeSet, edges: Mapping[Pair, Edge]) -> Iterator[_Matches]:
    grid = keyframes.grid
    for part in in_parts(sorted(edges), grid.on_gpu):
        ids = [i for i, _ in part]
        pixels, weight = edge_matches(grid, [edges[pair] for pair in part])
        yield _Matches(
            [keyframes[i].frame_index for i in ids],
            [keyframes[j].frame_index for _, j in part],
            keyframes.relative_poses(part),
            grid.rays,
            keyframes.inverse_depths(ids),
            pixels,
            keyframes.informations(ids),
            static_weight(keyframes, part, pixels, weight),
        )


def _of_frames(
    errors: RowErrors, keyframes: KeyframeSet, log: FrameLog, are_corrected: bool
) -> Iterator[_Matches]:
    grid = keyframes.grid
    cells = sparse_cells(grid)
    for part, ids in seen_by_keyframes(log, keyframes):
        target = [record.index for record, _ in part]
        found = torch.stack([o.shifted if are_corrected else o.of_one_lens for _, o in part])
        yield _Matches(
            [keyframes[k].frame_index for k in ids],
            target,
            errors.poses(target) @ se3_inverse(keyframes.poses(ids)),
            grid.rays[cells],
            keyframes.inverse_depths(ids)[:, cells],
            unpacked_positions(grid, found),
            keyframes.informations(ids)[:, cells],
            torch.stack([o.half_weight for _, o in part]).float(),
        )
