"""Local mapping: new keyframes are linked to their neighbours, adjusted with them, and culled."""

from collections.abc import Sequence
from typing import Any

import torch

from geogs.bundle.device_choice import grid_fields
from geogs.bundle.protocols import BundleOptions
from geogs.config import TrackingConfig
from geogs.geometry.lie import se3_inverse
from geogs.tracking.graph.dynamic_cells import propagated
from geogs.tracking.graph.frame_graph import HUBER
from geogs.tracking.graph.proximity import RADIUS, frame_distances, proximity_pairs
from geogs.tracking.keyframes.segment_map import SegmentMap
from geogs.tracking.locate.frame_locator import FrameMotion
from geogs.tracking.start.start_up import MIN_KEYFRAMES
from geogs.types import Frame
from geogs.world.edges import Pair, edge_matches
from geogs.world.frames import FrameRecord, RelativeRotation
from geogs.world.keyframes import Keyframe

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


class LocalMapping:
    """Inserts keyframes and adjusts the latest of them (the frontend of DROID-SLAM)."""

    def __init__(self, map: SegmentMap, config: TrackingConfig) -> None:
        self.map, self.config = map, config
        self.segment, self.keyframes, self.graph = map.segment, map.keyframes, map.graph
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
            self.map.sensor.join(keyframe, frame.depth)
        return keyframe

    def extend(self, record: FrameRecord, id: int, motion: FrameMotion) -> None:
        """Restore a located frame, keyframe ``id`` before the map was started, as the earliest or
        latest keyframe; link it to its neighbours and adjust them."""
        keyframe = self.map.restore(record, id, motion.T_cw)
        self._propagate_depths(self.keyframes[motion.keyframe], keyframe)
        ids, fixed = self.keyframes.ids, {*self.segment.fixed}
        if id == ids[-1]:
            self._link(keyframe, motion.keyframe)
            return
        self._connect(ids[1:PROXIMITY_WINDOW], ids[:1], (keyframe.id, motion.keyframe))
        self._propagate_dynamic(motion.keyframe, keyframe)
        self._adjust(
            [k for k in ids[: self.config.window] if k not in fixed and k != ids[-1]],
            [k for k in ids[: self.config.window + DEEPER] if k not in fixed],
        )

    def update(
        self,
        keyframe: Keyframe,
        anchor: int,
        rotations: Sequence[RelativeRotation],
        culls: bool = True,
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
        """Link the latest keyframe to its neighbours and adjust them."""
        ids = self.keyframes.ids
        self._connect(ids[-1:], ids[-PROXIMITY_WINDOW:-1], (anchor, keyframe.id))
        self._propagate_dynamic(anchor, keyframe)
        self._adjust(self.active, self.deep)

    def _propagate_depths(self, anchor: Keyframe, keyframe: Keyframe) -> None:
        T = keyframe.T_cw @ se3_inverse(anchor.T_cw)
        keyframe.inverse_depth, keyframe.information = grid_fields(self.keyframes.grid).transfer(
            T, anchor.inverse_depth, anchor.information
        )

    def _propagate_dynamic(self, anchor: int, keyframe: Keyframe) -> None:
        """Propagate dynamic cells of the anchor to a new keyframe."""
        (pixels,), (weight,) = edge_matches(
            self.keyframes.grid, [self.graph.edges[keyframe.id, anchor]]
        )
        moving = self.keyframes[anchor].moving
        keyframe.moving = propagated(self.keyframes.grid, moving, pixels, weight)

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
        moving, deep = set(poses), set(depths)
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
        before, id = ids[-3], ids[-2]
        if [self.keyframes[k].measured is not None for k in ids[-3:]] == [False, True, False]:
            return  # the only one nearby with sensor depth
        distance = frame_distances(self.keyframes, [(before, id), (id, before)]).mean()
        if float(distance) < self.config.keyframe_distance * self._long_edge:
            self.map.cull(id, before)
