"""Velocity of the camera while it reads a frame, by the rows of the frame's own matches.

A polynomial through the poses around a frame takes the course between images for smooth. A camera
that is knocked has another velocity, its rows are sheared, and the pose follows the shear. But the
matches of the frame tell its velocity beside its pose: each cell is moved by it in proportion to
the time of its row.
"""

from collections.abc import Iterator, Mapping
from itertools import chain
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.bundle.flow_term import weighed_residuals
from geogs.bundle.projection import linearise
from geogs.tracking.frames.frame_recorder import sparse_cells
from geogs.tracking.frames.pose_filling import HUBER, depth_aware_weight, observed_rows
from geogs.tracking.frames.row_errors import RowErrors, edge_shifts
from geogs.tracking.graph.dynamic_cells import static_weight
from geogs.tracking.locate.pose_deviation import PoseDeviation
from geogs.world.edges import Edge, Pair, edge_matches, unpacked_positions
from geogs.world.frames import FrameLog
from geogs.world.keyframes import KeyframeSet

EVIDENCE = 0.02
"""Fraction of what matches say of rows that counts, as those of an edge err together."""


class _Matches(NamedTuple):
    """Matches that end in frames, corrected for their rows."""

    frames: list[int]
    T_ji: Float[Tensor, "e 4 4"]
    rays: Float[Tensor, "p 3"]
    inverse_depth: Float[Tensor, "e p"]
    information: Float[Tensor, "e p"]
    pixels: Float[Tensor, "e p 2"]
    weight: Float[Tensor, "e p 2"]


class SolvedTwist(NamedTuple):
    """The twist of a frame while it was read."""

    twist: Float64[Tensor, "6"]
    """Per second, beside that of the trajectory; a left perturbation of the frame's pose."""
    leaves_open: PoseDeviation
    """Of the frame's pose, which follows what is not known of the twist."""


def row_twists(
    errors: RowErrors,
    keyframes: KeyframeSet,
    edges: Mapping[Pair, Edge],
    log: FrameLog,
    are_corrected: bool = False,
) -> dict[int, SolvedTwist]:
    """Twists of frames while they were read, by the matches that end in them.

    Each is estimated together with a step of the frame's pose, and is known before to be as small
    as two polynomials through the poses around differ (:meth:`RowErrors.twist_doubt`). Depths, and
    the poses of the frames that matches begin in, are taken for right.
    Source: pose and velocity from one image of a rolling shutter (Ait-Aider et al. 2006), with what
    is known of the velocity before by Bayes' rule.

    Args:
        errors: of rows by the present trajectory, of the readout that is taken for right.
        edges: matches between keyframes.
        log: frames, with what was found of them in keyframes.
        are_corrected: whether the matches are corrected for the rows already; else as ``errors``
            say.
    """
    sums: dict[int, Float64[Tensor, "12 13"]] = {}
    for part in chain(  # some edges at a time, as their equations take memory
        _of_keyframes(errors, keyframes, edges, are_corrected),
        _of_frames(errors, keyframes, log, are_corrected),
    ):
        for frame, equations in zip(part.frames, _equations(errors, keyframes, part), strict=True):
            sums[frame] = sums.get(frame, 0) + equations
    return {frame: solved_twist(A, errors.twist_doubt(frame)) for frame, A in sums.items()}


def solved_twist(A: Float64[Tensor, "12 13"], doubt: Float64[Tensor, "6"]) -> SolvedTwist:
    """Most likely twist by the normal equations of a step of the pose and a twist, and their right
    side, ``EVIDENCE`` of which counts, and its deviations before."""
    H, v = EVIDENCE * A[:, :12], EVIDENCE * A[:, 12:]
    eye = torch.eye(6, dtype=H.dtype)
    damped = H[:6, :6] + 1e-9 * H[:6, :6].diagonal().max().clamp(min=1e-9) * eye
    follow, step = torch.linalg.solve(damped, torch.cat([H[:6, 6:], v[:6]], 1)).split([6, 1], 1)
    S, g = H[6:, 6:] - H[6:, :6] @ follow, v[6:] - H[6:, :6] @ step
    open_ = doubt[:, None] * torch.linalg.inv(doubt[:, None] * S * doubt + eye) * doubt
    squares = (follow @ open_ @ follow.mT).diagonal().reshape(2, 3).sum(1)
    return SolvedTwist((open_ @ g)[:, 0], PoseDeviation(*squares.clamp(min=0).sqrt().tolist()))


def _equations(
    errors: RowErrors, keyframes: KeyframeSet, m: _Matches
) -> Float64[Tensor, "e 12 13"]:
    """Normal equations of each edge, for a step of the target's pose and its twist."""
    p = linearise(keyframes.grid.camera, m.rays, m.T_ji, m.inverse_depth)
    weight = depth_aware_weight(m.weight, p.depth_jacobian, m.information)
    r, w = weighed_residuals(p, m.pixels, weight, HUBER)
    seconds = errors.seconds(m.frames, m.pixels)
    J = torch.cat([p.pose_jacobian, seconds[:, None, None] * p.pose_jacobian], 1).flatten(2)
    wJ = J * w.mT.flatten(1)[:, None]
    return (wJ @ torch.cat([J, r.mT.flatten(1)[:, None]], 1).mT).double().cpu()


def _of_keyframes(
    errors: RowErrors, keyframes: KeyframeSet, edges: Mapping[Pair, Edge], are_corrected: bool
) -> Iterator[_Matches]:
    grid = keyframes.grid
    for part, (shift, _) in edge_shifts(errors, keyframes, edges):
        source = [i for i, _ in part]
        pixels, weight = edge_matches(grid, [edges[pair] for pair in part])
        yield _Matches(
            [keyframes[j].frame_index for _, j in part], keyframes.relative_poses(part), grid.rays,
            keyframes.inverse_depths(source), keyframes.informations(source),
            pixels if are_corrected else pixels + shift,
            static_weight(keyframes, part, pixels, weight),
        )  # fmt: skip


def _of_frames(
    errors: RowErrors, keyframes: KeyframeSet, log: FrameLog, are_corrected: bool
) -> Iterator[_Matches]:
    grid = keyframes.grid
    cells = sparse_cells(grid)
    for part, ids, T_ji, pixels, shift in observed_rows(log, keyframes, errors):
        corrected = pixels + shift
        if are_corrected:
            corrected = unpacked_positions(grid, torch.stack([o.shifted for _, o in part]))
        yield _Matches(
            [record.index for record, _ in part], T_ji, grid.rays[cells],
            keyframes.inverse_depths(ids)[:, cells], keyframes.informations(ids)[:, cells],
            corrected, torch.stack([o.half_weight for _, o in part]).float(),
        )  # fmt: skip
