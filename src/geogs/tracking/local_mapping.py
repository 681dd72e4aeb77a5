"""Local mapping: new keyframes are linked to their neighbours, adjusted with them, and culled; once
a map is started, earlier frames are tracked backwards, then forwards."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from geogs.bundle.device_choice import grid_fields
from geogs.bundle.protocols import BundleOptions
from geogs.config import TrackingConfig
from geogs.geometry.lie import se3_inverse
from geogs.tracking.frames.rotation_averaging import orientations
from geogs.tracking.graph.dynamic_cells import propagated
from geogs.tracking.graph.frame_graph import HUBER
from geogs.tracking.graph.proximity import RADIUS, frame_distances, proximity_pairs
from geogs.tracking.graph.rigid_parts import largest_part
from geogs.tracking.keyframes.keyframe_choice import calls_for_keyframe
from geogs.tracking.keyframes.segment_map import SegmentMap
from geogs.tracking.locate.frame_locator import FrameLocator, FrameMotion, with_depth
from geogs.tracking.locate.localiser import visible_keyframes
from geogs.tracking.start.start_up import MIN_KEYFRAMES
from geogs.types import Frame
from geogs.world.edges import Pair, edge_matches
from geogs.world.frames import FrameRecord, RelativeRotation
from geogs.world.keyframes import Keyframe, KeyframeSet

DEEPER = 3
"""Keyframes before the window of adjusted poses whose inverse depths are adjusted, too."""
PROXIMITY_WINDOW = 25
"""Older keyframes searched for further neighbours of a new one, as in DROID-SLAM."""
PROXIMITY_DISTANCE = 0.2
"""Largest frame distance of such neighbours, as a fraction of the long edge."""
PROXIMITY_PAIRS = 2
"""Most such neighbours per keyframe: bounds the time."""
ROUNDS = 2
"""Rounds of flow and adjustment per keyframe; the last is followed by the prior's."""
ITERATIONS = 3
"""Gauss-Newton steps per round."""
REMEASURE = 0.5
"""Change of its reprojection, in pixels, after which a pair is matched again."""
MIN_SHARED = 0.5
"""Least shared fraction of the cells for a rigid connection of two edges (:func:`largest_part`):
more than for a start, as these keyframes are dispensable."""


class LocalMapping:
    """Inserts keyframes and adjusts the latest of them (the frontend of DROID-SLAM)."""

    def __init__(self, map: SegmentMap, config: TrackingConfig) -> None:
        self.map = map
        self.config = config
        self.segment = map.segment
        self.keyframes = map.keyframes
        self.graph = map.graph
        self._long_edge = map.keyframes.grid.camera.long_edge

    @property
    def active(self) -> tuple[int, ...]:
        """Ids whose poses the local adjustment moves, earliest first; never the very first."""
        ids = self.segment.ids
        fixed = {*(self.segment.fixed or ids[:1])}
        return tuple(k for k in ids[-self.config.window :] if k not in fixed)

    @property
    def deep(self) -> list[int]:
        """Ids whose inverse depth the local adjustment moves, earliest first."""
        fixed = {*self.segment.fixed}
        latest = self.keyframes.ids[-(self.config.window + DEEPER) :]
        return [k for k in latest if k not in fixed]

    @property
    def lasting(self) -> Sequence[int]:
        """Ids that will not be removed: all but the latest, which may be culled after the next."""
        ids = self.keyframes.ids
        return ids[:-1] if self.config.keyframe_distance else ids

    def insert(self, frame: Frame, encoded: Any, motion: FrameMotion) -> Keyframe:
        """Make a located frame a keyframe, with depths propagated from its anchor."""
        anchor = self.keyframes[motion.keyframe]
        keyframe = self.map.add(frame, encoded, motion.T_cw)
        self._propagate_depths(anchor, keyframe)
        if self.segment.is_metric:
            self.map.add_sensor_depth(keyframe, frame.depth)
        return keyframe

    def extend(self, record: FrameRecord, id: int, motion: FrameMotion) -> None:
        """Restore a located frame, keyframe ``id`` before the map was started, as the earliest or
        latest keyframe; link it to its neighbours and adjust them."""
        keyframe = self.map.restore(record, id, motion.T_cw)
        self._propagate_depths(self.keyframes[motion.keyframe], keyframe)
        self._link(keyframe, motion.keyframe)

    def update(
        self, keyframe: Keyframe, anchor: int, rotations: Sequence[RelativeRotation], culls: bool
    ) -> None:
        """Link a new keyframe to its neighbours and adjust them.

        ``anchor`` is the keyframe at which it was located; without ``culls`` no keyframe is culled.
        """
        self.map.complete(keyframe, rotations)
        self._link(keyframe, anchor)
        self.map.odometry.update_scale()
        if culls:
            self._cull()

    def _link(self, keyframe: Keyframe, anchor: int) -> None:
        """Link the latest keyframe, or the earliest, to its neighbours and adjust them."""
        ids = self.keyframes.ids
        grid = self.keyframes.grid
        if keyframe.id == ids[-1]:
            self._connect(ids[-1:], ids[-PROXIMITY_WINDOW:-1], (anchor, keyframe.id))
            poses = self.active
            depths = self.deep
        else:
            self._connect(ids[1:PROXIMITY_WINDOW], ids[:1], (keyframe.id, anchor))
            depths = [k for k in ids[: self.config.window + DEEPER] if k not in self.segment.fixed]
            poses = tuple(k for k in ids[: self.config.window] if k in depths and k != ids[-1])
        (pixels,), (weight,) = edge_matches(grid, [self.graph.edges[keyframe.id, anchor]])
        keyframe.moving = propagated(grid, self.keyframes[anchor].moving, pixels, weight)
        self._adjust(poses, depths)

    def _propagate_depths(self, anchor: Keyframe, keyframe: Keyframe) -> None:
        T = keyframe.T_cw @ se3_inverse(anchor.T_cw)
        keyframe.inverse_depth, keyframe.information = grid_fields(self.keyframes.grid).transfer(
            T, anchor.inverse_depth, anchor.information
        )

    def _connect(self, later: Sequence[int], earlier: Sequence[int], located: Pair) -> None:
        """Measure flow between a new keyframe (the only one of ``later`` or of ``earlier``), the
        keyframe at which it was located, and its neighbours."""
        pairs = proximity_pairs(
            self.keyframes,
            later,
            earlier,
            self.graph.pairs,
            RADIUS,
            1,
            PROXIMITY_DISTANCE * self._long_edge,
            RADIUS + PROXIMITY_PAIRS,
        )
        # Neighbours in time do not count where the camera was lost in between.
        breaks = self.segment.breaks
        broken = [p for p in pairs if any(p[0] < b <= p[1] for b in breaks)]
        there, back = frame_distances(self.keyframes, broken + [p[::-1] for p in broken]).chunk(2)
        unseen = {p for p, d in zip(broken, (there + back).tolist(), strict=True) if d == torch.inf}
        pairs = [p for p in pairs if p not in unseen]
        self.graph.measure({*pairs, located}, fine=False)

    def _adjust(self, poses: Sequence[int], depths: Sequence[int]) -> None:
        """Run rounds of bundle adjustment; measure flow again where poses have changed."""
        moving = set(poses)
        deep = set(depths)
        for n in range(ROUNDS):
            edges = [e for e in self.graph.edges if e[0] in deep or not moving.isdisjoint(e)]
            if n:
                pairs = [e for e in edges if e[0] < e[1] and not moving.isdisjoint(e)]
                self.graph.measure(self.graph.stale(pairs, REMEASURE), fine=False)
            options = BundleOptions(iterations=ITERATIONS, huber=HUBER)
            self.graph.adjust(edges, poses, depths, options, bounded=True)
            if n == 0:
                self.graph.update_dynamic(deep, self.config.moving)
        self.map.priors.adjust(depths)
        self.graph.release(moving)

    def _cull(self) -> None:
        """Remove the keyframe before the last if it adds little (DROID-SLAM's keyframe test)."""
        ids = self.keyframes.ids
        if len(ids) <= MIN_KEYFRAMES or ids[-2] in self.segment.final:
            return
        before = ids[-3]
        id = ids[-2]
        if [self.keyframes[k].measured is not None for k in ids[-3:]] == [False, True, False]:
            return  # the only one nearby with sensor depth
        distance = frame_distances(self.keyframes, [(before, id), (id, before)]).mean()
        if float(distance) < self.config.keyframe_distance * self._long_edge:
            self.map.cull(id, before)


def track_from_start(local: LocalMapping, locator: FrameLocator) -> None:
    """Locate the frames without pose by the keyframes of a start: those before its last keyframe,
    latest first, then those after it.

    The initial guess is the known position nearest in time, with the orientation from relative
    rotations; their errors are correlated while the camera rotates and add up, over a full
    rotation, to more than flow can bridge. Keyframes of failed attempts become keyframes again if
    far enough from the others: else all these frames would depend on a keyframe that sees them at
    its border, and parts of the scene would have no depth. Drop those that are not rigidly
    connected.
    """
    recorder = local.map.recorder
    keyframes = local.keyframes
    waiting = recorder.unplaced()
    if not waiting:
        return
    rotations = {r.index: r.rotations for r in recorder.log.records}
    placed = {k.frame_index: k.T_cw for k in keyframes}
    # The earliest of the frames anchored to a dropped keyframe was that keyframe itself.
    given_up = {r.anchor: r for r in reversed(waiting) if r.anchor is not None}
    last = max(placed)
    extended = list[int]()
    for record in sorted(waiting, key=lambda r: (r.index > last, abs(r.index - last))):
        guess = placed[min(placed, key=lambda index: abs(index - record.index))]
        R = orientations(rotations, {n: T[:3, :3] for n, T in placed.items()}).get(record.index)
        guess = guess if R is None else _turned(guess, R)
        was = record.anchor
        record.anchor = None
        motion = _located(keyframes, locator, record.index, recorder.encoded(record), guess)
        if motion is None:
            continue
        placed[record.index] = motion.T_cw
        known = [k.frame_index for k in keyframes]
        is_outside = not known[0] <= record.index <= known[-1]
        is_far = calls_for_keyframe(local.config, keyframes.grid, motion)
        if was is not None and given_up[was] is record and is_outside and is_far:
            local.extend(record, was, motion)
            extended.append(was)
        else:
            T_rel = motion.T_cw @ se3_inverse(keyframes[motion.keyframe].T_cw)
            recorder.place(record, motion.keyframe, T_rel, motion.match)
    if extended:
        held = largest_part(keyframes, local.graph.edges, MIN_SHARED)
        local.map.forget([k for k in extended if k not in held])


def _located(
    keyframes: KeyframeSet,
    locator: FrameLocator,
    index: int,
    encoded: Any,
    guess: Float64[Tensor, "4 4"],
) -> FrameMotion | None:
    """Locate a frame at the keyframe nearest in time, or those that share most with the guess."""
    nearest = min(keyframes, key=lambda k: abs(k.frame_index - index))
    for keyframe in dict.fromkeys((nearest, *visible_keyframes(keyframes, guess))):
        motion = with_depth(locator.locate(keyframe, encoded, guess, is_expected=False))
        if motion is not None:
            return motion
    return None


def _turned(T_cw: Float64[Tensor, "4 4"], R: Float64[Tensor, "3 3"]) -> Float64[Tensor, "4 4"]:
    """Return the pose with the same camera centre and another orientation."""
    turned = T_cw.clone()
    turned[:3, :3] = R
    turned[:3, 3] = R @ T_cw[:3, :3].mT @ T_cw[:3, 3]
    return turned
