"""What rectified rows are still off by, once the trajectory and the depths are known.

Rows are rectified before anything is matched, by the motion that the flow between neighbouring
images tells. The trajectory of all frames tells it better: a point of a frame is seen at the time
of its row, and where it is then, the poses of the frames around say. What was assumed differs from
that by fractions of a pixel, so the matches are corrected to first order and the images stay.
"""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.projection import carried_over, project, seen_from_targets
from geogs.geometry.lie import se3_inverse
from geogs.shutter.rows import CELL
from geogs.types import SeenRows, Trajectory
from geogs.world.edges import Edge, Pair, edge_matches
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet

NODES = 5
"""Frames whose poses say where a point is at the time of its row."""
LONGEST_INTERVAL = 0.07
"""Seconds between two frames; over more, their poses say less of the rows than the video does."""
TOGETHER = 64, 512
"""Edges that are corrected at a time, on the CPU and on a GPU; bounds memory."""
LARGEST = 0.01
"""Fraction of the long edge; an error that seems larger is none of the rows."""


SMALL = 0.02
"""Part of the readout over which a derivative is taken."""


@dataclass(frozen=True)
class _RectifiedFrame:
    """The rows of a frame, and how the camera moved around it."""

    rows: SeenRows
    times: Float[Tensor, "5"]
    """Seconds of the nodes, from the frame."""
    motions: Float[Tensor, "5 4 4"]
    """From the camera at the frame to the camera at its nodes."""


class RowErrors:
    """Errors of the rows of frames, at a state of the trajectory."""

    def __init__(
        self,
        grid: SampleGrid,
        rows: Mapping[int, SeenRows],
        frames: Sequence[int],
        trajectory: Trajectory,
    ) -> None:
        """``rows`` by frame; ``frames`` are those of the trajectory, in its order.

        Frames without rows have no errors, nor have those with too few tracked neighbours.
        """
        self._grid = grid
        nodes = _nodes(trajectory)
        T_wc = torch.from_numpy(trajectory.T_wc)
        self._T_cw = dict(zip(frames, se3_inverse(T_wc), strict=True))
        self._rectified: dict[int, _RectifiedFrame] = {}
        self._factor = 1.0
        for n, (frame, around) in enumerate(zip(frames, nodes, strict=True)):
            if frame in rows and around is not None:
                times = trajectory.timestamps[around] - trajectory.timestamps[n]
                motions = (se3_inverse(T_wc[around]) @ T_wc[n]).float()
                self._rectified[frame] = _RectifiedFrame(
                    rows[frame], torch.from_numpy(times).float(), motions
                )

    def merged(self, other: "RowErrors") -> "RowErrors":
        """Those of the frames of both, of one camera and one unit; their numbers differ."""
        both = copy.copy(self)
        both._T_cw = self._T_cw | other._T_cw
        both._rectified = self._rectified | other._rectified
        return both

    @property
    def doubt(self) -> float:
        """Relative standard error of the readout; 0 where it was given, or nothing is known."""
        return next((f.rows.doubt for f in self._rectified.values()), 0.0)

    def with_readout(self, factor: float) -> "RowErrors":
        """The same, the readout being so many times what the rows were rectified by."""
        other = copy.copy(self)
        other._factor = factor
        return other

    def slope(self, shift: "Callable[[RowErrors], Float[Tensor, '*b']]") -> Float[Tensor, "*b"]:
        """Derivative of what is made of these by the factor on the readout."""
        low, high = (self.with_readout(self._factor + by) for by in (-SMALL, SMALL))
        return (shift(high) - shift(low)) / (2 * SMALL)

    def poses(self, frames: Sequence[int]) -> Float[Tensor, "n 4 4"]:
        """World to camera of frames in the trajectory, float64."""
        return torch.stack([self._T_cw[frame] for frame in frames])

    def of_matches(
        self,
        source: Sequence[int],
        target: Sequence[int],
        T_ji: Float[Tensor, "e 4 4"],
        rays: Float[Tensor, "p 3"],
        inverse_depth: Float[Tensor, "e p"],
        pixels: Float[Tensor, "e p 2"],
    ) -> Float[Tensor, "e p 2"]:
        """What is to be added to where cells were found, as if the rows of both frames were right.

        What a cell of the source shows lies next to it, and what was found in the target, too; the
        former is propagated to the target at the cell's own depth. Zero where the sum cannot be
        right.

        Args:
            source: frame that each edge begins in.
            target: and that it ends in.
            T_ji: from the camera of the source to that of the target.
            rays: of the cells of the source.
            inverse_depth: of the cells.
            pixels: where they were found in the target.
        """
        camera = self._grid.camera
        own = pixels.new_tensor([camera.fx, camera.fy]) * rays[:, :2]
        own = (own + pixels.new_tensor([camera.cx, camera.cy])).expand_as(pixels)
        p = project(camera, rays, T_ji, inverse_depth)
        there = self.of_pixels(target, pixels, inverse_depth / p.z)
        moved = carried_over(camera, T_ji, p, self.of_pixels(source, own, inverse_depth))
        error = there - moved
        believed = p.valid & (error.norm(dim=-1) < LARGEST * camera.long_edge)
        return torch.where(believed[..., None], error, 0.0)

    def of_pixels(
        self,
        frames: Sequence[int],
        pixels: Float[Tensor, "e p 2"],
        inverse_depth: Float[Tensor, "e p"],
    ) -> Float[Tensor, "e p 2"]:
        """By how much what pixels of frames show lies next to them at the middle row's time.

        The camera saw it in another position and at another time; by the poses around, the pixel's
        own point was elsewhere then. The difference is what the pixel shows instead, to first
        order.
        """
        error = torch.zeros_like(pixels)
        known = [n for n, frame in enumerate(frames) if frame in self._rectified]
        if not known:
            return error
        # Of several edges of a frame, what it has of its own is brought here once.
        order = {frame: n for n, frame in enumerate(dict.fromkeys(frames[n] for n in known))}
        rectified = [self._rectified[frame] for frame in order]
        at, which = (
            torch.tensor(numbers, device=pixels.device)
            for numbers in (known, [order[frames[n]] for n in known])
        )
        shown, d = pixels[at], inverse_depth[at]
        offset, seconds = seen_rows([f.rows for f in rectified], which, shown)
        seconds = self._factor * seconds
        T = torch.stack([f.motions for f in rectified]).to(shown)[which]
        times = torch.stack([f.times for f in rectified]).to(shown)[which]
        weights, camera = lagrange(times, seconds), self._grid.camera
        focal, centre = (
            shown.new_tensor([camera.fx, camera.fy]), shown.new_tensor([camera.cx, camera.cy])
        )  # fmt: skip
        plane = (shown - centre) / focal
        rays = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
        moved = torch.zeros_like(plane)
        for j in range(NODES):
            y, _, z = seen_from_targets(rays, T[:, j], d)
            moved += weights[..., j, None] * (y[..., :2] / z[..., None])
        error[at] = shown + offset - (moved * focal + centre)
        return error


def edge_shifts(
    errors: RowErrors,
    keyframes: KeyframeSet,
    measured: Mapping[Pair, Edge],
    frame_of: Callable[[int], int],
) -> Iterator[tuple[list[Pair], Float[Tensor, "e p 2"]]]:
    """Pixels by which the matches of edges are to be corrected, some edges at a time.

    ``frame_of`` a keyframe's id is the number that ``errors`` have of its frame.
    """
    pairs, grid = sorted(measured), keyframes.grid
    size = TOGETHER[grid.on_gpu]
    for start in range(0, len(pairs), size):
        part = pairs[start : start + size]
        source, target = ([pair[k] for pair in part] for k in (0, 1))
        T_ji = keyframes.relative_poses(part)
        pixels, _ = edge_matches(grid, [measured[pair] for pair in part])
        yield part, errors.of_matches(
            [frame_of(k) for k in source], [frame_of(k) for k in target], T_ji, grid.rays,
            keyframes.inverse_depths(source), pixels,
        )  # fmt: skip


def lagrange(times: Float[Tensor, "e j"], at: Float[Tensor, "e p"]) -> Float[Tensor, "e p j"]:
    """Weights of the values at ``times`` in that of the polynomial through them."""
    count = times.shape[1]
    weights = at.new_ones(*at.shape, count)
    for j in range(count):
        for other in range(count):
            if other != j:
                span = (times[:, j] - times[:, other])[:, None]
                weights[..., j] *= (at - times[:, other, None]) / span
    return weights


def _nodes(trajectory: Trajectory) -> list[np.ndarray | None]:
    """The frames around each whose poses are used; none where too few are known in a row."""
    n = len(trajectory.timestamps)
    linked = (np.diff(trajectory.timestamps) <= LONGEST_INTERVAL) & (
        np.diff(trajectory.timestamps) > 0
    )
    linked &= trajectory.tracked[1:] & trajectory.tracked[:-1]
    nodes: list[np.ndarray | None] = [None] * n
    ends = np.flatnonzero(np.diff(np.concatenate([[False], linked, [False]]).astype(int)))
    for first, last in ends.reshape(-1, 2):
        if last - first + 1 < NODES:
            continue
        for frame in range(first, last + 1):
            start = int(np.clip(frame - NODES // 2, first, last + 1 - NODES))
            nodes[frame] = np.arange(start, start + NODES)
    return nodes


def seen_rows(
    rows: Sequence[SeenRows], which: Int[Tensor, "e"], pixels: Float[Tensor, "e p 2"]
) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p"]]:
    """Offsets and seconds at pixels, each in ``which`` of the rows, bilinear between the nodes as
    the image was made."""
    laid = [torch.cat([r.offset, r.seconds[..., None]], -1) for r in rows]
    field = torch.stack(laid).to(pixels).permute(0, 3, 1, 2)[which]
    size = pixels.new_tensor([field.shape[3] * CELL, field.shape[2] * CELL])
    position = 2 * (pixels + CELL + 0.5) / size - 1
    values = torch.nn.functional.grid_sample(
        field, position[:, :, None], padding_mode="border", align_corners=False
    )[..., 0]
    return values[:, :2].mT, values[:, 2]
