"""New keyframes of a started map: linked to their neighbours, adjusted with them, and culled."""

from collections.abc import Sequence
from typing import Any

import torch

from geogs.bundle.base import BundleOptions
from geogs.bundle.select import grid_fields
from geogs.config import TrackingConfig
from geogs.geometry.lie import se3_inverse
from geogs.tracking.motion import FrameMotion
from geogs.tracking.moving import carried
from geogs.tracking.proximity import frame_distances, proximity_pairs
from geogs.tracking.segment_map import SegmentMap
from geogs.tracking.sensing import stands_alone
from geogs.tracking.start_up import MIN_KEYFRAMES
from geogs.types import Frame
from geogs.world.edges import edge_matches
from geogs.world.frames import RelativeRotation
from geogs.world.keyframes import Keyframe


class LocalMapping:
    """Inserts keyframes and adjusts the latest of them (the frontend of DROID-SLAM)."""

    def __init__(self, map: SegmentMap, config: TrackingConfig) -> None:
        self.map, self.config = map, config
        self.segment, self.keyframes, self.graph = map.segment, map.keyframes, map.graph
        camera = map.keyframes.grid.camera
        self._long_edge = max(camera.width, camera.height)

    @property
    def active(self) -> tuple[int, ...]:
        """Ids whose poses the local adjustment moves, earliest first; never the very first."""
        ids = self.segment.ids
        fixed = {*(self.segment.fixed or ids[:1])}
        return tuple(k for k in ids[-self._window() :] if k not in fixed)

    @property
    def deep(self) -> list[int]:
        """Ids whose inverse depth it moves, earliest first."""
        c, fixed = self.config, {*self.segment.fixed}
        latest = self.keyframes.ids[-(self._window() + c.depth_window - c.window) :]
        return [k for k in latest if k not in fixed]

    def _window(self) -> int:
        c = self.config
        return window_length(list(self.keyframes), c.window, c.window_most, c.window_baseline)

    def insert(self, frame: Frame, encoded: Any, motion: FrameMotion) -> Keyframe:
        """Make a located frame a keyframe, with the depths that its anchor gives it."""
        anchor = self.keyframes[motion.keyframe]
        keyframe = self.map.add(frame, encoded, motion.T_cw)
        T = motion.T_cw @ se3_inverse(anchor.T_cw)
        keyframe.inverse_depth, keyframe.information = grid_fields(self.keyframes.grid).transfer(
            T, anchor.inverse_depth, anchor.information
        )
        if self.segment.is_metric:
            self.map.sensing.join(keyframe, frame.depth)
        return keyframe

    def update(
        self, keyframe: Keyframe, anchor: int, rotations: Sequence[RelativeRotation]
    ) -> tuple[int, ...]:
        """Link a new keyframe to its neighbours and adjust them; returns the ids of those culled.

        ``anchor`` is the keyframe at which it was located.
        """
        self.map.complete(keyframe, rotations)
        self._connect(keyframe.id, anchor)
        (pixels,), (weight,) = edge_matches(
            self.keyframes.grid, [self.graph.edges[keyframe.id, anchor]]
        )
        moving = self.keyframes[anchor].moving
        keyframe.moving = carried(self.keyframes.grid, moving, pixels, weight)
        self._adjust()
        self.map.odometry.look()
        return self._cull()

    def _connect(self, id: int, anchor: int) -> None:
        """Measure a new keyframe against the one it was located at, and its neighbours."""
        c, ids = self.config, self.keyframes.ids
        pairs = proximity_pairs(
            self.keyframes,
            [id],
            ids[-c.proximity_window : -1],
            self.graph.pairs,
            c.radius,
            1,
            c.proximity_distance * self._long_edge,
            c.radius + c.proximity_pairs,
        )
        # Neighbours in time are none where the camera was lost in between.
        breaks = self.segment.breaks
        broken = [p for p in pairs if any(p[0] < b <= p[1] for b in breaks)]
        there, back = frame_distances(self.keyframes, broken + [p[::-1] for p in broken]).chunk(2)
        apart = {p for p, d in zip(broken, (there + back).tolist(), strict=True) if d == torch.inf}
        pairs = [p for p in pairs if p not in apart]
        self.graph.measure({*pairs, (anchor, id)}, fine=False)

    def _adjust(self) -> None:
        """Rounds of bundle adjustment, with flow measured anew where poses have moved."""
        c, poses, depths = self.config, self.active, self.deep
        moving, deep, priors = set(poses), set(depths), self.map.priors
        for n in range(c.local_rounds):
            edges = [e for e in self.graph.edges if e[0] in deep or not moving.isdisjoint(e)]
            if n:
                pairs = [e for e in edges if e[0] < e[1] and not moving.isdisjoint(e)]
                self.graph.measure(self.graph.stale(pairs, c.remeasure), fine=False)
            self.graph.adjust(
                edges, poses, depths, BundleOptions(iterations=c.local_iterations, huber=c.huber)
            )
            if n == 0:
                self.graph.judge_moving(deep, c.moving)
            if n >= c.local_rounds - priors.config.rounds:
                priors.adjust(depths, c.huber)
        self.graph.release(moving)

    def _cull(self) -> tuple[int, ...]:
        """Remove the keyframe before the last if it adds little (DROID-SLAM's keyframe test)."""
        ids = self.keyframes.ids
        if len(ids) <= MIN_KEYFRAMES or ids[-2] in self.segment.final:
            return ()
        before, id = ids[-3], ids[-2]
        if stands_alone([self.keyframes[k] for k in ids[-3:]]):
            return ()
        distance = frame_distances(self.keyframes, [(before, id), (id, before)]).mean()
        if float(distance) >= self.config.cull_distance * self._long_edge:
            return ()
        self.map.cull(id, before)
        return (id,)


def window_length(keyframes: Sequence[Keyframe], least: int, most: int, baseline: float) -> int:
    """How many of the latest keyframes are adjusted together, earliest of all first.

    As many as it takes until the camera has moved from one of them to the newest by ``baseline`` of
    the newest's median depth, so that together they say something about depth: a camera that
    turns makes many keyframes at one position. Between ``least`` and ``most``, or all there are.
    """
    count = min(least, len(keyframes))
    if baseline == 0 or count == len(keyframes):
        return count
    newest = keyframes[-1]
    known = newest.information > 0
    if not bool(known.any()):
        return count
    far = baseline / float(newest.inverse_depth[known].median().clamp(min=1e-9))
    here = se3_inverse(newest.T_cw)[:3, 3]
    for back in range(1, min(most, len(keyframes)) + 1):
        there = se3_inverse(keyframes[-back].T_cw)[:3, 3]
        if float(torch.linalg.norm(there - here)) >= far:
            return max(count, back)
    return max(count, min(most, len(keyframes)))
