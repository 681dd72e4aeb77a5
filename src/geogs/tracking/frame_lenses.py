"""Per-frame intrinsics of frames between keyframes, from each frame's own matches."""

from collections.abc import Iterator, Mapping

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.bundle.flow_term import weighed_residuals
from geogs.bundle.projection import CellProjection, linearise, project
from geogs.bundle.uncertainty.lens_error import SHAPES, lens_shapes, shifts_of_edges
from geogs.bundle.uncertainty.varying_intrinsics import COUNTS, OWN, VaryingPrior
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.tracking.frames.frame_recorder import sparse_cells
from geogs.tracking.frames.pose_filling import (
    HUBER,
    depth_aware_weight,
    seen_by_keyframes,
    solved_poses,
)
from geogs.types import FrameLens
from geogs.world.edges import in_steps, unpacked_positions
from geogs.world.frames import FrameLog
from geogs.world.keyframes import KeyframeSet

STEPS = 5
"""Gauss-Newton steps of each frame's pose and lens together."""

Sizes = Float64[Tensor, "3"]
"""Per-frame intrinsics: ``FrameLens.sizes``."""


def sizes_of_frames(
    log: FrameLog, keyframes: KeyframeSet, of_keyframes: Mapping[int, Sizes], varies: VaryingPrior
) -> dict[int, Sizes]:
    """Estimate the intrinsics of all located frames, by their indices.

    Args:
        log: frames, with their matches from keyframes.
        of_keyframes: intrinsics of keyframes, by the indices of their frames; assumed exact, as are
            poses and depths of keyframes.
        varies: prior on the difference between a frame's intrinsics and those interpolated from the
            keyframes around.
    """
    known = sorted(of_keyframes)
    table = torch.stack([of_keyframes[n] for n in known]).numpy()
    poses = solved_poses(log, keyframes)
    between = sorted(set(poses) - set(known))
    time = {record.index: record.timestamp for record in log.records}
    at, known_at = (np.array([time[n] for n in some], float) for some in (between, known))
    each = [np.interp(at, known_at, column) for column in table.T]
    expected = torch.from_numpy(np.stack(each, 1))
    sizes = {**of_keyframes, **dict(zip(between, expected, strict=True))}
    place = {n: k for k, n in enumerate(between)}
    inverse = varies.between(known_at, at).square().reciprocal()
    prior = torch.diag_embed(torch.cat([inverse.new_zeros(len(at), 6), inverse], 1))
    for _ in range(STEPS if between else 0):
        A = torch.zeros(len(between), 9, 10, dtype=torch.float64)
        for frames, equations in _equations(log, keyframes, poses, sizes):
            for n, e in zip(frames, equations, strict=True):
                if n in place:
                    A[place[n]] += COUNTS * e
        off = torch.stack([sizes[n] for n in between]) - expected
        right = A[..., 9:] - prior @ torch.cat([off.new_zeros(len(off), 6), off], 1)[..., None]
        damping = 1e-9 * (1 + A[..., :9].diagonal(dim1=1, dim2=2).amax(1))
        step = torch.linalg.solve(
            A[..., :9] + prior + damping[:, None, None] * torch.eye(9).double(), right
        )[..., 0]
        for n, s in zip(between, step, strict=True):
            poses[n] = se3_exp(s[:6]) @ poses[n]
            sizes[n] = sizes[n] + s[6:]
    return sizes


def shift_frames(log: FrameLog, keyframes: KeyframeSet, lenses: Mapping[int, FrameLens]) -> None:
    """Store the correction of the frames' matches for the intrinsics of both images."""
    sizes = {n: torch.tensor(lens.sizes).double() for n, lens in lenses.items()}
    poses = solved_poses(log, keyframes)
    grid = keyframes.grid
    for part, ids in seen_by_keyframes(log, keyframes):
        frames = [record.index for record, _ in part]
        _, shift = _shifts(keyframes, ids, frames, poses, sizes)
        for (_, observation), step in zip(part, in_steps(grid.camera, shift), strict=True):
            observation.lens_shift = step


def shifts_of_own(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_ji: Float[Tensor, "e 4 4"],
    at: CellProjection,
    own: Float[Tensor, "e 2 3"],
) -> Float[Tensor, "e p 2"]:
    """Return the shifts of matches to the positions that the shared lens would give.

    Args:
        camera: shared camera.
        rays: of the cells.
        T_ji: from the camera of each edge's source to that of its target.
        at: projections of the cells.
        own: per-frame intrinsics of each edge's source and target.
    """
    # Exact for any size, except that the shift of the source cell is propagated to first order.
    source, target = own.unbind(1)
    sizes = own.new_zeros(len(own), 2, SHAPES)
    sizes[:, 0, list(OWN)] = torch.cat([-(-source[:, :1]).expm1(), source[:, 1:]], 1)
    factor = target[:, :1].exp()
    sizes[:, 1, list(OWN)] = torch.cat([target[:, :1].expm1(), factor * target[:, 1:]], 1)
    return shifts_of_edges(camera, rays, T_ji, at, sizes)


def _shifts(
    keyframes: KeyframeSet,
    ids: list[int],
    frames: list[int],
    poses: Mapping[int, Float[Tensor, "4 4"]],
    sizes: Mapping[int, Sizes],
) -> tuple[Float[Tensor, "e 4 4"], Float[Tensor, "e p 2"]]:
    """Return relative motions from keyframes to frames, and the shifts of the matches."""
    grid = keyframes.grid
    cells = sparse_cells(grid)
    T = torch.stack([poses[n] for n in frames]) @ se3_inverse(keyframes.poses(ids))
    at = project(grid.camera, grid.rays[cells], T, keyframes.inverse_depths(ids)[:, cells])
    zero = torch.zeros(len(OWN), dtype=torch.float64)
    both = [
        torch.stack([sizes.get(keyframes[k].frame_index, zero), sizes.get(n, zero)])
        for k, n in zip(ids, frames, strict=True)
    ]
    each = torch.stack(both).to(at.pixels)
    return T, shifts_of_own(grid.camera, grid.rays[cells], T, at, each)


def _equations(
    log: FrameLog,
    keyframes: KeyframeSet,
    poses: Mapping[int, Float[Tensor, "4 4"]],
    sizes: Mapping[int, Sizes],
) -> Iterator[tuple[list[int], Float64[Tensor, "e 9 10"]]]:
    """Yield frames, and normal equations of each of their observations with right sides."""
    grid = keyframes.grid
    cells = sparse_cells(grid)
    own = list(OWN)
    for part, ids in seen_by_keyframes(log, keyframes):
        frames = [record.index for record, _ in part]
        T, shift = _shifts(keyframes, ids, frames, poses, sizes)
        p = linearise(grid.camera, grid.rays[cells], T, keyframes.inverse_depths(ids)[:, cells])
        weight = torch.stack([o.half_weight for _, o in part]).float()
        information = keyframes.informations(ids)[:, cells]
        weight = depth_aware_weight(weight, p.depth_jacobian, information)
        found = unpacked_positions(grid, torch.stack([o.of_one_time for _, o in part]))
        r, w = weighed_residuals(p, found + shift, weight, HUBER)
        lens = -lens_shapes(grid.camera, p.pixels)[own].permute(1, 0, 3, 2)
        J = torch.cat([p.pose_jacobian, lens], 1).flatten(2)
        wJ = J * w.mT.flatten(1)[:, None]
        yield frames, (wJ @ torch.cat([J, r.mT.flatten(1)[:, None]], 1).mT).double().cpu()
