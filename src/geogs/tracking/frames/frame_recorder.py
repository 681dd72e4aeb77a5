"""Recording of the data by which every frame is located once the keyframes are final."""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.device_choice import grid_fields
from geogs.geometry.lie import se3_inverse
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.types import FlowMatch, FoundFrames, Frame
from geogs.world.edges import pack_matches
from geogs.world.frames import FrameLog, FrameRecord, Observation, RelativeRotation
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeSet

MAX_WAITING = 64
"""Most frames whose images wait for keyframes to become final."""
MEASURED_TOGETHER = 8
"""Pairs of a frame and a keyframe measured at a time."""
MAX_ROTATIONS, ROTATION_THREADS = 16, 4
"""Most rotations of frames measured in the background, and number of threads."""


class FrameRecorder:
    """Keeps the log of a segment's frames.

    Images wait only until the keyframes around them are final; then the flow from both is measured
    and every second cell of it is kept.
    """

    def __init__(self, frames: FrameLog, keyframes: KeyframeSet, operator: FlowOperator) -> None:
        self._log = frames
        self._keyframes = keyframes
        self._operator = operator
        self._waiting = _in_order([r for r in frames.records if r.image is not None])
        self._rotations: deque[tuple[FrameRecord, Future[RelativeRotation | None]]] = deque()
        self._threads = ThreadPoolExecutor(ROTATION_THREADS, thread_name_prefix="rotations")
        self._cells = sparse_cells(keyframes.grid)

    @property
    def log(self) -> FrameLog:
        """All frames, after waiting for the measurement of their rotations."""
        self._await_rotations(0)
        return self._log

    def note_rows(self, frame: Frame) -> None:
        """Record how the rows of a frame were rectified, whether it is tracked or not."""
        if frame.rows is not None and frame.rows.is_rectified:
            self._log.rows[frame.index] = frame.rows
        else:
            self._log.open_rows = frame.rows

    # --- new frames ------------------------------------------------------------------------

    def add_untracked(
        self, index: int, timestamp: float, rotations: Sequence[RelativeRotation] = ()
    ) -> None:
        """Add a frame that could not be located, though its orientation may be known."""
        eye = torch.eye(4, dtype=torch.float64)
        record = FrameRecord(index, timestamp, None, eye, rotations=[*rotations])
        self._log.records.append(record)

    def add(
        self,
        frame: Frame,
        encoded: Any,
        anchor: int,
        T_rel: Float[Tensor, "4 4"],
        match: FlowMatch | None = None,
        rotations: Sequence[RelativeRotation] = (),
    ) -> None:
        """Add a frame at ``T_rel`` from the anchor keyframe, with the flow that located it."""
        record = FrameRecord(
            frame.index,
            frame.timestamp,
            anchor,
            T_rel,
            self._keyframes[anchor].scale,
            rotations=[*rotations],
            image=frame.image,
            encoded=encoded,
        )
        if match is not None:
            self._observe([(record, anchor)], match)
        self._log.records.append(record)
        self._waiting.append(record)
        if len(self._waiting) > MAX_WAITING:
            self._stop_waiting(self._waiting[: MAX_WAITING // 2])

    def add_keyframe(self, keyframe: Keyframe, rotations: Sequence[RelativeRotation] = ()) -> None:
        """Add a frame that is a keyframe."""
        eye = torch.eye(4, dtype=torch.float64)
        record = FrameRecord(
            keyframe.frame_index,
            keyframe.timestamp,
            keyframe.id,
            eye,
            keyframe.scale,
            rotations=[*rotations],
        )
        self._log.records.append(record)

    def measure_rotation(self, measure: Callable[[], RelativeRotation | None]) -> None:
        """Measure another rotation of the latest frame in a background thread."""
        self._rotations.append((self._log.records[-1], self._threads.submit(measure)))
        self._await_rotations(MAX_ROTATIONS)

    def _await_rotations(self, most: int) -> None:
        """Wait until at most that many rotations are being measured."""
        while len(self._rotations) > most:
            record, measured = self._rotations.popleft()
            found = measured.result()
            if found is not None:
                record.rotations.insert(0, found)

    # --- changes of earlier frames ---------------------------------------------------------

    def keyframe_removed(self, removed: Keyframe, substitute: int) -> None:
        """Make a culled keyframe an ordinary frame; frames anchored to it move to another one."""
        base = removed.T_cw @ se3_inverse(self._keyframes[substitute].T_cw)
        # Frames are located from keyframes before them.
        for record in reversed(self._log.records):
            if record.index < removed.frame_index:
                break
            if record.anchor == removed.id:
                T_rel = removed.at_present_scale(record.T_rel, record.scale) @ base
                record.anchor = substitute
                record.T_rel = T_rel
                record.scale = self._keyframes[substitute].scale
                record.observations = [o for o in record.observations if o.keyframe != removed.id]
                if record.index == removed.frame_index:
                    self._let_wait(record, removed)

    def keyframe_forgotten(self, removed: Keyframe) -> None:
        """Keep the image of a dropped keyframe, as that of a frame without a pose."""
        record = next((r for r in self.log.records if r.index == removed.frame_index), None)
        if record is not None:
            self._let_wait(record, removed)

    def keyframe_restored(self, record: FrameRecord, keyframe: Keyframe) -> None:
        """Make a frame whose keyframe was dropped a keyframe again."""
        _anchor(record, keyframe, torch.eye(4, dtype=torch.float64))
        self._stop_waiting([record])

    def unplaced(self) -> list[FrameRecord]:
        """Return waiting frames without an anchor keyframe, earliest first."""
        ids = {*self._keyframes.ids}
        return [r for r in self._waiting if r.anchor not in ids]

    def place(
        self, record: FrameRecord, anchor: int, T_rel: Float[Tensor, "4 4"], match: FlowMatch
    ) -> None:
        """Set the pose of a frame, with the flow that located it."""
        _anchor(record, self._keyframes[anchor], T_rel)
        self._observe([(record, anchor)], match)

    def place_found(self, found: FoundFrames, others: Sequence["FrameRecorder"]) -> None:
        """Set the poses of frames that were relocalised after the stream.

        Each is relative to the keyframe nearest in time, without matches; frames in the logs of
        ``others`` are taken over.
        """
        poses = dict(zip(found.numbers, torch.from_numpy(found.T_cw), strict=True))
        for other in others:
            theirs = other.log.records
            self._log.records.extend(r for r in theirs if r.index in poses)
            theirs[:] = [r for r in theirs if r.index not in poses]
        self._log.records[:] = _in_order(self._log.records)
        for record in (r for r in self.log.records if r.index in poses):
            nearest = min(self._keyframes, key=lambda k: abs(k.frame_index - record.index))
            _anchor(record, nearest, poses[record.index] @ se3_inverse(nearest.T_cw))
            record.is_found = True

    def absorb(self, other: "FrameRecorder") -> None:
        """Take over the frames of another recorder, whose keyframes are now in this one's table."""
        self._log.records[:] = _in_order([*self.log.records, *other.log.records])
        self._log.rows |= other.log.rows
        self._waiting = _in_order([*self._waiting, *other._waiting])

    def give_up(self, other: "FrameRecorder") -> None:
        """Take over the frames of another recorder as frames that were not tracked."""
        for record in other.log.records:
            self.add_untracked(record.index, record.timestamp, record.rotations)
        self._log.rows |= other.log.rows

    def finalise(self, before: int, after: int | None) -> None:
        """Measure the waiting frames up to keyframe ``after`` against it and the one ``before``."""
        end = None if after is None else self._keyframes[after].frame_index
        ready = [r for r in self._waiting if end is None or r.index < end]
        jobs = [
            (r, k)
            for r in ready
            for k in (before, after)
            if k is not None
            and r.anchor is not None
            and r.anchor in self._keyframes
            and not r.observes(k)
        ]
        for start in range(0, len(jobs), MEASURED_TOGETHER):
            self._measure(jobs[start : start + MEASURED_TOGETHER])
        self._stop_waiting(ready)

    def _let_wait(self, record: FrameRecord, keyframe: Keyframe) -> None:
        """Keep the image of a frame that is no longer a keyframe."""
        record.image = keyframe.image
        record.encoded = keyframe.encoded
        self._waiting = _in_order([*self._waiting, record])

    def _stop_waiting(self, records: Sequence[FrameRecord]) -> None:
        for record in records:
            record.forget_image()
        self._waiting = [r for r in self._waiting if r.image is not None]

    def encoded(self, record: FrameRecord) -> Any:
        """Return the encoded image of a waiting frame."""
        if record.encoded is None:
            assert record.image is not None, "a frame that does not wait has no image"
            record.encoded = self._operator.encode(record.image)
        return record.encoded

    def _measure(self, jobs: list[tuple[FrameRecord, int]]) -> None:
        keyframes = [self._keyframes[k] for _, k in jobs]
        poses = [pose_of(r, self._keyframes) for r, _ in jobs]
        forward, backward = grid_fields(self._keyframes.grid).reproject(keyframes, poses)
        there, _ = self._operator.measure(
            [k.encoded for k in keyframes],
            [self.encoded(r) for r, _ in jobs],
            forward,
            backward,
            fine=False,
        )
        self._observe(jobs, there)

    def _observe(self, jobs: list[tuple[FrameRecord, int]], match: FlowMatch) -> None:
        """Store the matches of records with keyframes."""
        pixels = match.pixels[:, self._cells]
        weight = match.weight[:, self._cells]
        position, half_weight = pack_matches(self._keyframes.grid, pixels, weight)
        for n, (record, keyframe) in enumerate(jobs):
            # The test would wait for the GPU; an observation without weight does no harm.
            if self._keyframes.grid.on_gpu or bool((weight[n] > 0).any()):
                record.observations.append(Observation(keyframe, position[n], half_weight[n]))


def _anchor(record: FrameRecord, keyframe: Keyframe, T_rel: Float[Tensor, "4 4"]) -> None:
    """Set the pose of a frame relative to a keyframe, without matches."""
    record.anchor = keyframe.id
    record.T_rel = T_rel
    record.scale = keyframe.scale
    record.observations = []


def pose_of(record: FrameRecord, keyframes: KeyframeSet) -> Float[Tensor, "4 4"]:
    """Return world to camera of a frame by the present pose and scale of its anchor."""
    assert record.anchor is not None, "a frame that was not tracked has no pose"
    return record.T_cw(keyframes[record.anchor])


def sparse_cells(grid: SampleGrid) -> Int[Tensor, "s"]:
    """Return the indices of every second cell in both directions."""
    keep = torch.zeros(grid.height, grid.width, dtype=torch.bool, device=grid.device)
    keep[::2, ::2] = True
    return torch.nonzero(keep.reshape(-1))[:, 0]


def _in_order(records: Sequence[FrameRecord]) -> list[FrameRecord]:
    return sorted(records, key=lambda r: r.index)
