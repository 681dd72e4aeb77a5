"""The pose of every frame, solved at the end from sparse flow kept along the way."""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Int16, UInt8
from torch import Tensor

from geogs.bundle.problem import MotionProblem
from geogs.bundle.projection import linearise
from geogs.bundle.select import grid_fields, motion_solver
from geogs.errors import InputError
from geogs.geometry.lie import retract, se3_inverse, se3_log, so3_log
from geogs.tracking.flow.base import FlowOperator
from geogs.tracking.gaps import bridged
from geogs.tracking.packed_edge import in_steps, pack_matches, unpacked_positions
from geogs.tracking.row_errors import RowErrors
from geogs.tracking.turns import Turn, orientations
from geogs.types import FlowMatch, Frame, SeenRows, Trajectory
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeSet

ASTRAY = 0.05
"""Radians by which a frame's orientation may differ from one between its keyframes."""
MOST_TURNING, TURNING_THREADS = 16, 4
"""Frames whose turns are measured beside while others come, and by how many threads."""


@dataclass
class Observation:
    """Flow from a keyframe to a frame on every second cell, packed."""

    keyframe: int
    position: Int16[Tensor, "s 2"]
    half_weight: Float16[Tensor, "s 2"]
    shift: Int16[Tensor, "s 2"] | None = None
    """Steps to be added to the position, for the rows of the two (``row_errors.py``)."""

    @property
    def shifted(self) -> Int16[Tensor, "s 2"]:
        """The position with its shift."""
        return self.position if self.shift is None else self.position + self.shift


@dataclass
class FrameRecord:
    """One frame of the stream."""

    index: int
    timestamp: float
    anchor: int | None
    """Keyframe that the pose is relative to; None where the frame was not tracked."""
    T_rel: Float[Tensor, "4 4"]
    """Anchor keyframe to this frame."""
    scale: float = 1.0
    """Of the anchor when that was measured."""
    observations: list[Observation] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)
    """Against earlier frames: what is left to go by where there is no depth."""

    def sees(self, keyframe: int) -> bool:
        """Whether the flow from that keyframe has been measured."""
        return any(o.keyframe == keyframe for o in self.observations)


@dataclass
class _Pending:
    record: FrameRecord
    image: UInt8[np.ndarray, "h w 3"]
    encoded: Any


@dataclass(frozen=True, eq=False)
class RecorderState:
    """What a checkpoint holds of a recorder."""

    records: list[FrameRecord]
    pending: dict[int, UInt8[np.ndarray, "h w 3"]]
    """Images of the frames that wait, by their indices."""
    rows: dict[int, SeenRows] = field(default_factory=dict)
    """How those of a rolling shutter were rectified, by the indices of the frames."""


class TrajectoryRecorder:
    """Keeps what is needed to place every frame once the keyframes are final.

    Images wait only until the keyframes around them are safe from culling; then the flow from both
    is measured and every second cell of it is kept.
    """

    def __init__(self, store: KeyframeSet, operator: FlowOperator, max_pending: int = 64) -> None:
        self.keyframes, self.operator, self.max_pending = store, operator, max_pending
        self._records: list[FrameRecord] = []
        self._turning: deque[tuple[FrameRecord, Future[Turn | None]]] = deque()
        self._beside = ThreadPoolExecutor(TURNING_THREADS, thread_name_prefix="turns")
        self.rows: dict[int, SeenRows] = {}
        """How those of a rolling shutter were rectified, by the indices of the frames."""
        self._pending: list[_Pending] = []
        self._subset = torch.nonzero(sparse_cells(store.grid))[:, 0]

    @property
    def records(self) -> list[FrameRecord]:
        """Of all frames, with all that is known of their turns."""
        self._turn(0)
        return self._records

    def state(self) -> RecorderState:
        """What a checkpoint holds."""
        waiting = {p.record.index: p.image for p in self._pending}
        return RecorderState(self.records, waiting, self.rows)

    def load(self, state: RecorderState) -> None:
        """Give a recorder without frames those of another.

        Raises:
            InputError: they are of another camera, or one that waits is unknown.
        """
        camera, cells = self.keyframes.grid.camera, len(self._subset)
        by_index = {record.index: record for record in state.records}
        seen = [len(o.position) for record in state.records for o in record.observations]
        images = [image.shape[:2] for image in state.pending.values()]
        if {*seen} - {cells} or {*images} - {(camera.height, camera.width)}:
            raise InputError("the frames are of another camera")
        if state.pending.keys() - by_index.keys():
            raise InputError("a frame that waits is unknown")
        self._records, self.rows = state.records, state.rows
        self._pending = [
            _Pending(by_index[n], image, self.operator.encode(image))
            for n, image in state.pending.items()
        ]

    def see(self, frame: Frame) -> None:
        """Note how the rows of a frame were rectified, whatever becomes of it."""
        if frame.rows is not None:
            self.rows[frame.index] = frame.rows

    def add_untracked(self, index: int, timestamp: float, turns: Sequence[Turn] = ()) -> None:
        """A frame that could not be located, though its orientation may be known."""
        eye = torch.eye(4, dtype=torch.float64)
        self._records.append(FrameRecord(index, timestamp, None, eye, turns=[*turns]))

    def add(
        self,
        frame: Frame,
        encoded: Any,
        anchor: int,
        T_rel: Float[Tensor, "4 4"],
        match: FlowMatch | None = None,
        turns: Sequence[Turn] = (),
    ) -> None:
        """A frame at ``T_rel`` from the anchor keyframe, with the flow that located it."""
        scale = self.keyframes[anchor].scale
        record = FrameRecord(frame.index, frame.timestamp, anchor, T_rel, scale, turns=[*turns])
        if match is not None:
            self._observe([(record, anchor)], match)
        self._records.append(record)
        self._pending.append(_Pending(record, frame.image, encoded))
        if len(self._pending) > self.max_pending:
            del self._pending[: self.max_pending // 2]

    def add_keyframe(self, id: int, turns: Sequence[Turn] = ()) -> None:
        """A frame that is a keyframe."""
        state = self.keyframes[id]
        eye = torch.eye(4, dtype=torch.float64)
        self._records.append(
            FrameRecord(state.frame_index, state.timestamp, id, eye, state.scale, turns=[*turns])
        )

    def turned(self, measure: Callable[[], Turn | None]) -> None:
        """Have another turn of the latest frame measured beside what is done with the next ones."""
        self._turning.append((self._records[-1], self._beside.submit(measure)))
        self._turn(MOST_TURNING)

    def _turn(self, most: int) -> None:
        """Wait until no more turns than that are being measured."""
        while len(self._turning) > most:
            record, measured = self._turning.popleft()
            found = measured.result()
            if found is not None:
                record.turns.insert(0, found)

    def keyframe_removed(self, removed: Keyframe, substitute: int) -> None:
        """Make a culled keyframe an ordinary frame; frames anchored to it move to another one."""
        base = removed.T_cw @ se3_inverse(self.keyframes[substitute].T_cw)
        # Frames are located from keyframes before them.
        for record in reversed(self._records):
            if record.index < removed.frame_index:
                break
            if record.anchor == removed.id:
                T_rel = removed.at_present_scale(record.T_rel, record.scale) @ base
                record.anchor, record.T_rel = substitute, T_rel
                record.scale = self.keyframes[substitute].scale
                record.observations = [o for o in record.observations if o.keyframe != removed.id]
                if record.index == removed.frame_index:
                    self._pending.append(_Pending(record, removed.image, removed.encoded))
        self._pending.sort(key=lambda p: p.record.index)

    def keyframe_forgotten(self, removed: Keyframe) -> None:
        """Keep the image of a keyframe that was given up, as that of a frame without a place."""
        record = next((r for r in self.records if r.index == removed.frame_index), None)
        if record is not None:
            self._pending.append(_Pending(record, removed.image, removed.encoded))
            self._pending.sort(key=lambda p: p.record.index)

    def take_unplaced(self) -> list[tuple[FrameRecord, Any]]:
        """Frames that wait without a keyframe to be relative to, and their encoded images.

        They wait no longer.
        """
        placed = {*self.keyframes.ids}
        without = [p for p in self._pending if p.record.anchor not in placed]
        self._pending = [p for p in self._pending if p.record.anchor in placed]
        return [(p.record, p.encoded) for p in without]

    def place(
        self, record: FrameRecord, anchor: int, T_rel: Float[Tensor, "4 4"], match: FlowMatch
    ) -> None:
        """Say where a frame is after all, with the flow that located it."""
        record.anchor, record.T_rel, record.scale = anchor, T_rel, self.keyframes[anchor].scale
        record.observations = []
        self._observe([(record, anchor)], match)

    def absorb(self, other: "TrajectoryRecorder") -> None:
        """Take over the frames of another recorder, whose keyframes are now in this one's store."""
        self._records = sorted([*self.records, *other.records], key=lambda r: r.index)
        self._pending = sorted([*self._pending, *other._pending], key=lambda p: p.record.index)
        self.rows |= other.rows

    def give_up(self, other: "TrajectoryRecorder") -> None:
        """Take over the frames of another recorder as frames that were not tracked."""
        for record in other.records:
            self.add_untracked(record.index, record.timestamp, record.turns)
        self.rows |= other.rows

    def anchor_to_keyframes(self) -> None:
        """Give the frames seen before the map was started a pose between their keyframes.

        One whose turns tell another orientation has none: it was seen while the camera looked away
        from both.
        """
        states = list(self.keyframes)
        indices = [s.frame_index for s in states]
        turned = orientations(
            {r.index: r.turns for r in self.records},
            {s.frame_index: s.T_cw[:3, :3] for s in states},
        )
        for record in self.records:
            if record.anchor is None or record.anchor not in self.keyframes:
                continue
            n = indices.index(self.keyframes[record.anchor].frame_index)
            a, b = states[n], states[min(n + 1, len(states) - 1)]
            span = max(b.frame_index - a.frame_index, 1)
            share = (record.index - a.frame_index) / span
            xi = se3_log(b.T_cw @ se3_inverse(a.T_cw))
            record.T_rel, record.scale = retract(share * xi, torch.eye(4).to(xi)), a.scale
            R = turned.get(record.index)
            if R is not None and _apart(R, (record.T_rel @ a.T_cw)[:3, :3]) > ASTRAY:
                record.anchor = None

    def finalise(self, before: int, after: int | None) -> None:
        """Measure the waiting frames up to keyframe ``after`` against it and the one ``before``."""
        end = None if after is None else self.keyframes[after].frame_index
        ready = [p for p in self._pending if end is None or p.record.index < end]
        self._pending = [p for p in self._pending if end is not None and p.record.index >= end]
        jobs = [
            (p, k)
            for p in ready
            for k in (before, after)
            if k is not None
            and p.record.anchor is not None
            and p.record.anchor in self.keyframes
            and not p.record.sees(k)
        ]
        for start in range(0, len(jobs), 8):
            self._measure(jobs[start : start + 8])

    def _measure(self, jobs: list[tuple[_Pending, int]]) -> None:
        keyframes = [self.keyframes[k] for _, k in jobs]
        poses = [self._pose(p.record) for p, _ in jobs]
        forward, backward = grid_fields(self.keyframes.grid).reproject(keyframes, poses)
        there, _ = self.operator.measure(
            [k.encoded for k in keyframes],
            [p.encoded for p, _ in jobs],
            forward,
            backward,
            fine=False,
        )
        self._observe([(p.record, k) for p, k in jobs], there)

    def _observe(self, jobs: list[tuple[FrameRecord, int]], match: FlowMatch) -> None:
        """Keep the matches of records with keyframes."""
        pixels, weight = match.pixels[:, self._subset], match.weight[:, self._subset]
        position, half_weight = pack_matches(self.keyframes.grid, pixels, weight)
        for n, (record, keyframe) in enumerate(jobs):
            # Asking would wait for the GPU; an observation without weight does no harm.
            if self.keyframes.grid.on_gpu or bool((weight[n] > 0).any()):
                record.observations.append(Observation(keyframe, position[n], half_weight[n]))

    def _pose(self, record: FrameRecord) -> Float[Tensor, "4 4"]:
        assert record.anchor is not None, "a frame that was not tracked has no pose"
        anchor = self.keyframes[record.anchor]
        return anchor.at_present_scale(record.T_rel, record.scale) @ anchor.T_cw

    def solve(
        self, apart: Sequence[FrameRecord] = (), chunk: int = 64, has_map: bool = True
    ) -> Trajectory:
        """Poses of all frames seen so far on the present keyframes, real timestamps.

        Of untracked frames, and those ``apart`` on other keyframes, the position is interpolated
        between their neighbours, and the orientation is what turns say, else interpolated, too.
        Without a map (``has_map``) nothing but turns is known of any.
        """
        records = sorted([*self.records, *apart], key=lambda r: r.index)
        keyframes = {s.frame_index: s.id for s in self.keyframes}
        located = records if has_map else []
        tracked = [r for r in located if r.anchor is not None and r.anchor in self.keyframes]
        free = [r for r in tracked if r.index not in keyframes and r.observations]
        solved: dict[int, Tensor] = {r.index: self._pose(r) for r in tracked}
        for start in range(0, len(free), chunk):
            part = free[start : start + chunk]
            poses = self._solve_chunk(part)
            solved.update({r.index: T for r, T in zip(part, poses, strict=True)})
        turned = orientations(
            {r.index: r.turns for r in records}, {n: T[:3, :3] for n, T in solved.items()}
        )
        timestamps = np.array([r.timestamp for r in records], dtype=np.float64)
        return bridged(
            timestamps,
            [solved.get(r.index) for r in records],
            [turned.get(r.index) for r in records],
        )

    def row_errors(self) -> RowErrors | None:
        """What rectified rows are off by at the present state; none where there are none."""
        if not self.rows:
            return None
        frames = sorted(record.index for record in self.records)
        return RowErrors(self.keyframes.grid, self.rows, frames, self.solve())

    def shift_rows(self, errors: RowErrors, chunk: int = 64) -> None:
        """Correct what was found of frames by the errors of their rows and their keyframes'."""
        grid, cells = self.keyframes.grid, self._subset
        seen = [
            (r, o) for r in self.records for o in r.observations if o.keyframe in self.keyframes
        ]
        for start in range(0, len(seen), chunk):
            part = seen[start : start + chunk]
            ids = [o.keyframe for _, o in part]
            T = errors.poses([r.index for r, _ in part]) @ se3_inverse(self.keyframes.poses(ids))
            shifts = errors.of_matches(
                [self.keyframes[k].frame_index for k in ids], [r.index for r, _ in part], T,
                grid.rays[cells], self.keyframes.inverse_depths(ids)[:, cells],
                unpacked_positions(grid, torch.stack([o.position for _, o in part])),
            )  # fmt: skip
            steps = in_steps(grid.camera, shifts)
            for (_, observation), shift in zip(part, steps, strict=True):
                observation.shift = shift

    def _solve_chunk(self, records: list[FrameRecord]) -> Float[Tensor, "n 4 4"]:
        grid, cells = self.keyframes.grid, self._subset
        pairs = [
            (n, o)
            for n, r in enumerate(records)
            for o in r.observations
            if o.keyframe in self.keyframes
        ]
        start = torch.stack([self._pose(r) for r in records])
        if not pairs:
            return start
        ids = [o.keyframe for _, o in pairs]
        frame = torch.tensor([n for n, _ in pairs])
        depth = self.keyframes.inverse_depths(ids)[:, cells]
        information = self.keyframes.informations(ids)[:, cells]
        source = self.keyframes.poses(ids)
        weight = torch.stack([o.half_weight for _, o in pairs]).float()
        p = linearise(grid.camera, grid.rays[cells], start[frame] @ se3_inverse(source), depth)
        weight = depth_aware_weight(weight, p.depth_jacobian, information)
        pixels = unpacked_positions(grid, torch.stack([o.shifted for _, o in pairs]))
        problem = MotionProblem(start, depth, source, frame, pixels, weight)
        T, _ = motion_solver(grid, cells).solve(problem, iterations=8)
        return T


def _apart(first: Float[Tensor, "3 3"], second: Float[Tensor, "3 3"]) -> float:
    """Radians between two rotations."""
    return float(so3_log(first @ second.mT).norm())


def sparse_cells(grid: SampleGrid) -> Bool[Tensor, "p"]:
    """Every second cell in both directions."""
    keep = torch.zeros(grid.height, grid.width, dtype=torch.bool, device=grid.device)
    keep[::2, ::2] = True
    return keep.reshape(-1)


def depth_aware_weight(
    weight: Float[Tensor, "e p 2"],
    depth_jacobian: Float[Tensor, "e p 2"],
    information: Float[Tensor, "e p"],
) -> Float[Tensor, "e p 2"]:
    """Inverse variance of a match plus that of the keyframe's depth carried into the image."""
    depth = depth_jacobian.square() / information.clamp(min=1e-12)[..., None]
    variance = 1 / weight.clamp(min=1e-12) + depth
    return (weight > 0) * (information > 0)[..., None] / variance
