"""Errors of rectified rows, once the trajectory and the depths are known.

Rows are rectified before matching, by the motion estimated from flow between neighbouring images.
The trajectory of all frames is more accurate: a point is seen at the time of its row, and the poses
of the frames around give its position then. The rectification differs from that by fractions of a
pixel, so the matches are corrected to first order and the images are not changed.
"""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.bundle.projection import MIN_Z, carried_over, project, seen_from_targets
from geogs.camera.shutter.rows import CELL
from geogs.geometry.lie import se3_exp, se3_inverse, se3_log
from geogs.tracking.frames.seen_rows import node_values, rows_at
from geogs.types import FrameLens, SeenRows, Trajectory
from geogs.world.edges import Edge, Pair, edge_matches
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet

NODES = 5
"""Frames whose poses are interpolated at the time of a row."""
LONGEST_INTERVAL = 0.3
"""Longest interval between frames, seconds, at which their poses are used for rows. At a fifth of a
second they help little, but with the matches (``row_twists``) the error falls to a third to two
thirds (docs/notebook/shutter.md)."""
TOGETHER = 64, 512
"""Edges, or frames, processed together, on the CPU and on a GPU; bounds memory."""
MAX_SHIFT = 0.01
"""Largest row error, as a fraction of the long edge; larger shifts have other causes."""

T = TypeVar("T")


class RowShifts(NamedTuple):
    """Shifts in pixels, and their derivatives by the readout."""

    shift: Float[Tensor, "e p 2"]
    slope: Float[Tensor, "e p 2"]
    """Derivative by the factor on the readout."""


@dataclass(frozen=True)
class _RectifiedFrame:
    """Rows of a frame, and the camera's motion around it."""

    rows: SeenRows
    nodes: tuple[int, ...]
    """Frames around it, including itself."""
    times: Float[Tensor, "5"]
    """Times of the nodes relative to the frame, seconds."""
    motions: Float[Tensor, "5 4 4"]
    """Motions from the camera at the frame to the camera at its nodes."""


class RowErrors:
    """Errors of the rows of frames, at a state of the trajectory."""

    def __init__(
        self,
        grid: SampleGrid,
        rows: Mapping[int, SeenRows],
        frames: Sequence[int],
        trajectory: Trajectory,
        longest_interval: float = LONGEST_INTERVAL,
    ) -> None:
        """``rows`` by frame; ``frames`` are those of the trajectory, in its order.

        Frames without rows have no errors, nor have those with too few tracked neighbours at most
        ``longest_interval`` seconds apart.
        """
        self._grid = grid
        nodes = _nodes(trajectory, longest_interval)
        T_wc = torch.from_numpy(trajectory.T_wc)
        self._T_cw = dict(zip(frames, se3_inverse(T_wc), strict=True))
        self._rectified: dict[int, _RectifiedFrame] = {}
        self._factor = 1.0
        for n, (frame, around) in enumerate(zip(frames, nodes, strict=True)):
            if frame in rows and around is not None:
                times = trajectory.timestamps[around] - trajectory.timestamps[n]
                motions = (se3_inverse(T_wc[around]) @ T_wc[n]).float()
                own = tuple(frames[node] for node in around)
                self._rectified[frame] = _RectifiedFrame(
                    rows[frame], own, torch.from_numpy(times).float(), motions
                )

    def merged(self, other: "RowErrors") -> "RowErrors":
        """Return the errors of the frames of both, of one camera and unit; their numbers differ."""
        both = copy.copy(self)
        both._T_cw = self._T_cw | other._T_cw
        both._rectified = self._rectified | other._rectified
        return both

    @property
    def doubt(self) -> float:
        """Relative standard error of the readout; 0 where it was given, or nothing is known."""
        return next((f.rows.doubt for f in self._rectified.values()), 0.0)

    def with_readout(self, factor: float) -> "RowErrors":
        """Return a copy with the readout scaled by ``factor``."""
        other = copy.copy(self)
        other._factor = factor
        return other

    def with_twists(self, frames: Sequence[int], twists: Float64[Tensor, "n 6"]) -> "RowErrors":
        """Return a copy with additional twists, per second, while these frames are read."""
        known, own = self._known(frames)
        other = copy.copy(self)
        if known:
            times = torch.stack([f.times for f in own]).double()
            more = se3_exp(times[..., None] * twists[known][:, None]).float()
            moved = more @ torch.stack([f.motions for f in own])
            other._rectified = self._rectified | {
                frames[n]: replace(f, motions=T) for n, f, T in zip(known, own, moved, strict=True)
            }
        return other

    def with_lenses(self, lenses: Mapping[int, FrameLens]) -> "RowErrors":
        """Return a copy with principal points of frames that move during readout.

        Images are corrected for per-frame intrinsics, but rows are not: a principal point that
        moves during readout shears the image as a rotation of the camera does.
        """
        if not lenses:
            return self
        other = copy.copy(self)
        turns = {frame: _turn_of(lenses.get(frame, FrameLens())) for frame in self._T_cw}
        other._rectified = {
            frame: replace(
                f,
                motions=torch.stack([turns[n] for n in f.nodes])
                @ f.motions
                @ se3_inverse(turns[frame]),
            )
            for frame, f in self._rectified.items()
        }
        return other

    def twists(self, frames: Sequence[int]) -> Float64[Tensor, "n 6"]:
        """Return twists of frames per second: the slope of the polynomial through the poses around.
        Zero for frames without rows."""
        twists = torch.zeros(len(frames), 6, dtype=torch.float64)
        known, own = self._known(frames)
        if known:
            twists[known] = slope_at_zero(*_nodes_of(own))
        return twists

    def twist_deviations(self, frames: Sequence[int]) -> Float64[Tensor, "n 6"]:
        """Return deviations of these twists: the difference of the slopes of the polynomials
        through all poses around and through the nearest three, in translation and rotation.

        Zero for frames without rows. Source: embedded formulas of numerical differentiation.
        """
        deviations = torch.zeros(len(frames), 6, dtype=torch.float64)
        known, own = self._known(frames)
        if known:
            times, moved = _nodes_of(own)
            nearest = times.abs().argsort(1)[:, :3]
            by_three = slope_at_zero(
                times.gather(1, nearest), moved.gather(1, nearest[..., None].expand(-1, -1, 6))
            )
            off = (slope_at_zero(times, moved) - by_three).reshape(-1, 2, 3).norm(dim=2)
            deviations[known] = off.repeat_interleave(3, 1)
        return deviations

    def seconds(
        self, frames: Sequence[int], pixels: Float[Tensor, "e p 2"]
    ) -> Float[Tensor, "e p"]:
        """Return times of pixels of frames, from the middle row; zero for frames without rows."""
        found = torch.zeros_like(pixels[..., 0])
        known, own = self._known(frames)
        if known:
            at = torch.tensor(known, device=pixels.device)
            which = torch.arange(len(known), device=pixels.device)
            _, when = rows_at([f.rows for f in own], which, pixels[at])
            found[at] = self._factor * when
        return found

    def _known(self, frames: Sequence[int]) -> tuple[list[int], list[_RectifiedFrame]]:
        """Return the positions of the frames with rows in the list, and their rows and motion."""
        known = [n for n, frame in enumerate(frames) if frame in self._rectified]
        return known, [self._rectified[frames[n]] for n in known]

    def poses(self, frames: Sequence[int]) -> Float[Tensor, "n 4 4"]:
        """Return world to camera of frames in the trajectory, float64."""
        return torch.stack([self._T_cw[frame] for frame in frames])

    def of_matches(
        self,
        source: Sequence[int],
        target: Sequence[int],
        T_ji: Float[Tensor, "e 4 4"],
        rays: Float[Tensor, "p 3"],
        inverse_depth: Float[Tensor, "e p"],
        pixels: Float[Tensor, "e p 2"],
    ) -> RowShifts:
        """Return shifts of matches that correct the rows of both frames.

        The point seen by a source cell is shifted, and so is its match in the target; the former
        shift is propagated to the target at the cell's depth. Zero where the sum is implausible.

        Args:
            source: source frame of each edge.
            target: target frame of each edge.
            T_ji: from the camera of the source to that of the target.
            rays: of the cells of the source.
            inverse_depth: of the cells.
            pixels: their matches in the target.
        """
        camera = self._grid.camera
        own = camera.pixels(rays[:, :2]).expand_as(pixels)
        p = project(camera, rays, T_ji, inverse_depth)
        there = self.of_pixels(target, pixels, inverse_depth / p.z)
        here = self.of_pixels(source, own, inverse_depth)
        shift, slope = (
            t - carried_over(camera, rays, T_ji, p, h) for t, h in zip(there, here, strict=True)
        )
        believed = p.valid & (shift.norm(dim=-1) < MAX_SHIFT * camera.long_edge)
        return RowShifts(*(torch.where(believed[..., None], x, 0.0) for x in (shift, slope)))

    def of_pixels(
        self,
        frames: Sequence[int],
        pixels: Float[Tensor, "e p 2"],
        inverse_depth: Float[Tensor, "e p"],
    ) -> RowShifts:
        """Return shifts of pixels of frames to the true position of their content at the time of
        the middle row.

        The camera saw it at another position and time; by the poses around, the pixel's own point
        was elsewhere then. To first order, the shift is the difference of the two.
        """
        found = RowShifts(*(pixels.new_zeros(pixels.shape) for _ in range(2)))
        # Data of a frame is transferred once, even for several edges.
        rectified = {f: self._rectified[f] for f in dict.fromkeys(frames) if f in self._rectified}
        if rectified and pixels.is_cuda:
            known = [n for n, frame in enumerate(frames) if frame in rectified]
            order = {frame: n for n, frame in enumerate(rectified)}
            at = torch.tensor(known, device=pixels.device)
            found.shift[at], found.slope[at] = self._shifted(
                list(rectified.values()),
                [order[frames[n]] for n in known],
                pixels[at],
                inverse_depth[at],
            )
        elif rectified:
            from geogs.geometry.bend_kernels import lens_arguments
            from geogs.tracking.frames.row_kernels import shift_pixels

            camera = lens_arguments(self._grid.camera)
            limits = np.array([CELL, MIN_Z], np.float32)
            factor = np.float32(self._factor)
            own = {
                frame: (node_values(f.rows).float().numpy(), f.times.numpy(), f.motions.numpy())
                for frame, f in rectified.items()
            }
            inputs = pixels, self._grid.camera.plane(pixels), inverse_depth
            each = zip(*(x.contiguous().numpy() for x in (*inputs, *found)), strict=True)
            for frame, edge in zip(frames, each, strict=True):
                if frame in own:
                    shift_pixels(*own[frame], *camera, limits, factor, *edge)
        return found

    def _shifted(
        self,
        rectified: Sequence[_RectifiedFrame],
        which: Sequence[int],
        pixels: Float[Tensor, "e p 2"],
        inverse_depth: Float[Tensor, "e p"],
    ) -> RowShifts:
        """Do :meth:`of_pixels` for edges, each in ``which`` of the frames, in plain PyTorch."""
        camera = self._grid.camera
        at = torch.tensor(which, device=pixels.device)
        offset, seconds = rows_at([f.rows for f in rectified], at, pixels)
        T = torch.stack([f.motions for f in rectified]).to(pixels)[at]
        times = torch.stack([f.times for f in rectified]).to(pixels)[at]
        weights, changes = lagrange(times, self._factor * seconds)
        focal = pixels.new_tensor([camera.fx, camera.fy])
        plane = camera.plane(pixels)
        rays = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
        moved = torch.zeros_like(plane)
        change = torch.zeros_like(plane)
        for j in range(NODES):
            y, _, z = seen_from_targets(rays, T[:, j], inverse_depth)
            there = y[..., :2] / z[..., None]
            moved += weights[j][..., None] * there
            change += changes[j][..., None] * there
        return RowShifts(
            pixels + offset - camera.pixels(moved),
            -seconds[..., None] * camera.bent_step(moved, change) * focal,
        )


def row_shifts(
    errors: RowErrors,
    keyframes: KeyframeSet,
    part: Sequence[Pair],
    measured: Mapping[Pair, Edge],
    frame_of: Callable[[int], int] | None = None,
) -> RowShifts:
    """Return the corrections, in pixels, of the matches of some edges.

    ``frame_of`` maps a keyframe's id to its frame in ``errors``; default: its frame index.
    """
    frame_of = frame_of or (lambda id: keyframes[id].frame_index)
    pixels, _ = edge_matches(keyframes.grid, [measured[pair] for pair in part])
    return errors.of_matches(
        [frame_of(i) for i, _ in part],
        [frame_of(j) for _, j in part],
        keyframes.relative_poses(part),
        keyframes.grid.rays,
        keyframes.inverse_depths([i for i, _ in part]),
        pixels,
    )


def edge_shifts(
    errors: RowErrors,
    keyframes: KeyframeSet,
    measured: Mapping[Pair, Edge],
    frame_of: Callable[[int], int] | None = None,
) -> Iterator[tuple[list[Pair], RowShifts]]:
    """Yield :func:`row_shifts` of all edges, in parts."""
    for part in in_parts(sorted(measured), keyframes.grid.on_gpu):
        yield part, row_shifts(errors, keyframes, part, measured, frame_of)


def in_parts(items: list[T], on_gpu: bool) -> Iterator[list[T]]:
    """Yield parts of as many items as are processed together."""
    size = TOGETHER[on_gpu]
    for start in range(0, len(items), size):
        yield items[start : start + size]


def lagrange(
    times: Float[Tensor, "e 5"], at: Float[Tensor, "e p"]
) -> tuple[list[Float[Tensor, "e p"]], list[Float[Tensor, "e p"]]]:
    """Return the Lagrange weights of the values at ``times`` for interpolation at ``at``, and their
    derivatives by ``at``."""
    off = [at - time[:, None] for time in times.unbind(1)]
    spans = times[:, :, None] - times[:, None]
    scale = (1 / (spans + torch.eye(NODES).to(spans)).prod(-1)).unbind(1)
    weights = []
    changes = []
    for j in range(NODES):
        a, b, c, d = (off[other] for other in range(NODES) if other != j)
        ab = a * b
        cd = c * d
        by = scale[j][:, None]
        weights.append(ab * cd * by)
        changes.append((ab * (c + d) + cd * (a + b)) * by)
    return weights, changes


def slope_at_zero(
    times: Float64[Tensor, "n k"], values: Float64[Tensor, "n k m"]
) -> Float64[Tensor, "n m"]:
    """Return derivatives at zero of the polynomials through the values."""
    unit = times.abs().amax(1, keepdim=True)
    return torch.linalg.solve(torch.linalg.vander(times / unit), values)[:, 1] / unit


def _nodes_of(
    frames: Sequence[_RectifiedFrame],
) -> tuple[Float64[Tensor, "n 5"], Float64[Tensor, "n 5 6"]]:
    """Return times of the nodes of frames, and the logarithms of the motions to them."""
    times = torch.stack([f.times for f in frames]).double()
    return times, se3_log(torch.stack([f.motions for f in frames]).double())


def _turn_of(lens: FrameLens) -> Float[Tensor, "4 4"]:
    """Return the camera rotation that moves an image as its principal point does."""
    return se3_exp(torch.tensor([0.0, 0.0, 0.0, -lens.down, lens.right, 0.0]))


def _nodes(trajectory: Trajectory, longest_interval: float) -> list[np.ndarray | None]:
    """Return the nodes around each frame; None where too few in a row are known."""
    intervals = np.diff(trajectory.timestamps)
    linked = (intervals <= longest_interval) & (intervals > 0)
    linked &= trajectory.tracked[1:] & trajectory.tracked[:-1]
    nodes: list[np.ndarray | None] = [None] * len(trajectory.timestamps)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], linked, [False]]).astype(int)))
    for first, last in ends.reshape(-1, 2):
        if last - first + 1 < NODES:
            continue
        for frame in range(first, last + 1):
            start = int(np.clip(frame - NODES // 2, first, last + 1 - NODES))
            nodes[frame] = np.arange(start, start + NODES)
    return nodes
