"""Keyframes of a segment with their edges, priors, sensor depth and log."""

import logging
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.device_choice import grid_fields
from geogs.config import Config, PriorConfig
from geogs.errors import InputError
from geogs.priors.depth_sensor import sensor_depth
from geogs.priors.monocular_prior import MonocularPrior, align_inverse_depth
from geogs.tracking.depth_prior import DEVIATION, FlowEvidence, adjust_depth, flow_evidence
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.frames.frame_recorder import FrameRecorder
from geogs.tracking.graph.frame_graph import HUBER, FrameGraph
from geogs.tracking.graph.measured_odometry import Odometry
from geogs.types import Frame, MeasuredDepth, RenderedKeyframe
from geogs.world.cell_depths import KeyframePrior, MeasuredCells
from geogs.world.frames import FrameRecord, RelativeRotation
from geogs.world.grid import OFFSET, STRIDE, SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeSet
from geogs.world.segments import TrackState, VideoSegment

RENDERED_DEVIATION = 0.01
"""Relative deviation of a map's rendered depth, where its confidence is 1."""
ONE_SURFACE = 1.1
"""Largest ratio of the depths of four neighbouring pixels on one surface."""
CAUTION = 4.0
"""Factor on a prior's deviation for mapping, which assumes that a tracker's deviations are
overestimated (``DEVIATION_SCALE``, ``TRACKER_SCALE`` of depth/)."""

_log = logging.getLogger(__name__)


class SegmentMap:
    """Adds keyframes to a segment and removes them, keeping all their data consistent."""

    def __init__(
        self,
        segment: VideoSegment,
        operator: FlowOperator,
        config: Config,
        prior: MonocularPrior | None = None,
    ) -> None:
        self.segment = segment
        self.operator = operator
        self.keyframes = keyframes = segment.keyframes
        self.odometry = Odometry(keyframes, config.odometry, segment.odometry)
        self.graph = FrameGraph(keyframes, operator, self.odometry, segment.edges)
        self.recorder = FrameRecorder(segment.frames, keyframes, operator)
        self.priors = KeyframePriors(self.graph, prior, config.prior)
        self._sensor = config.sensor

    def add(self, frame: Frame, encoded: Any, T_cw: Float[Tensor, "4 4"] | None = None) -> Keyframe:
        """Make a frame a keyframe at a pose (default: identity); depths are unknown."""
        T_cw = torch.eye(4, dtype=torch.float64) if T_cw is None else T_cw
        keyframe = self.keyframes.add(frame.index, frame.timestamp, frame.image, encoded, T_cw)
        keyframe.pose = frame.pose
        return keyframe

    def complete(self, keyframe: Keyframe, rotations: Sequence[RelativeRotation]) -> None:
        """Predict the prior of a new keyframe, and log its frame."""
        self.priors.ask(keyframe)
        self.recorder.add_keyframe(keyframe, rotations)

    def add_sensor_depth(self, keyframe: Keyframe, depth: MeasuredDepth | None) -> bool:
        """Set depths of a new keyframe's cells to those of a sensor, in metres, where it has any;
        return whether there is a depth image. Unknown cells are filled from those around, without
        information."""
        metres = None if depth is None else depth.metres()
        if metres is None:
            return False
        keyframe.sensor_depth = metres
        grid = self.keyframes.grid
        cells = sensor_depth(metres, self._sensor).at_cells(OFFSET, STRIDE, grid.height, grid.width)
        measured = MeasuredCells(*(m.reshape(-1) for m in cells.tensors(grid.device)))
        keyframe.measured = measured
        known = measured.information > 0
        depths = torch.where(known, measured.inverse_depth, keyframe.inverse_depth)
        information = torch.where(known, measured.information, keyframe.information)
        keyframe.inverse_depth = grid_fields(grid).fill(depths, information)
        keyframe.information = information
        return True

    def cull(self, id: int, substitute: int) -> None:
        """Make a keyframe an ordinary frame; those anchored to it move to a substitute."""
        self.graph.remove_keyframe(id)
        self.recorder.keyframe_removed(self.keyframes.remove(id), substitute)

    def forget(self, ids: Sequence[int]) -> None:
        """Drop keyframes; their frames then have no pose."""
        for id in ids:
            self.graph.remove_keyframe(id)
            self.recorder.keyframe_forgotten(self.keyframes.remove(id))

    def restore(self, record: FrameRecord, id: int | None, T_cw: Float[Tensor, "4 4"]) -> Keyframe:
        """Make a waiting frame a keyframe: again with its former ``id``, or as the latest."""
        assert record.image is not None, "a frame that does not wait has no image"
        encoded = self.recorder.encoded(record)
        keyframe = self.keyframes.add(
            record.index, record.timestamp, record.image, encoded, T_cw, id
        )
        self.priors.ask(keyframe)
        self.recorder.keyframe_restored(record, keyframe)
        return keyframe

    def finalise(self, ids: Sequence[int]) -> tuple[int, ...]:
        """Make keyframes final; return those that were not final before."""
        final = self.segment.final
        known = set(final)
        fresh = tuple(k for k in ids if k not in known)
        for id in fresh:
            if final:
                self.recorder.finalise(final[-1], id)
            final.append(id)
        return fresh

    def absorb(self, other: "SegmentMap") -> None:
        """Take over the keyframes and frames of another map, already in this one's gauge."""
        self.keyframes.absorb(other.keyframes)
        self.graph.replace(dict(sorted({**self.graph.edges, **other.graph.edges}.items())))
        self.recorder.absorb(other.recorder)


class KeyframePriors:
    """Adds priors to keyframes and adjusts depth with them where matches determine little.

    Does nothing without a prior.
    """

    def __init__(
        self, graph: FrameGraph, prior: MonocularPrior | None, config: PriorConfig
    ) -> None:
        self.graph = graph
        self.prior = prior
        self.config = config
        self._warned = False

    def ask(self, keyframe: Keyframe) -> None:
        """Predict the prior of a new keyframe; no depth where it was measured by a sensor."""
        if self.prior is None:
            return
        maps = self.prior.predict(keyframe.image)
        grid = self.graph.keyframes.grid
        if maps.normal is not None:
            keyframe.prior_normal = self._facing(maps.normal.cpu())
        if maps.depth is not None and keyframe.measured is None:
            cells = maps.depth[OFFSET::STRIDE, OFFSET::STRIDE][: grid.height, : grid.width]
            values = cells.reshape(-1).float().to(grid.device)
            zero = torch.zeros_like(values)
            one = values.new_ones(self.config.scale_rows * self.config.scale_columns)
            keyframe.prior = KeyframePrior(maps.kind, values, zero, one, zero)

    def _facing(self, normal: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        """Return normals that face the camera; zero in place of others."""
        away = (normal * self.graph.keyframes.grid.camera.rays()).sum(-1, keepdim=True) >= 0
        known = normal.square().sum(-1, keepdim=True) > 0
        if not self._warned and int((away & known).sum()) > 0.5 * int(known.sum()):
            self._warned = True
            _log.warning("Most prior normals face away from the camera; check their normal_axes.")
        return torch.where(away, 0.0, normal)

    def adjust(self, ids: Sequence[int]) -> None:
        """Adjust depth and scale of the keyframes that have a prior jointly, poses fixed."""
        store = self.graph.keyframes
        priors = {k: prior for k in ids if (prior := store[k].prior) is not None}
        edges = [e for e in self.graph.edges if e[0] in priors]
        if not edges:
            return
        problem, frames = self.graph.problem(edges, [], {i for i, _ in edges})
        flow = flow_evidence(store.grid, problem, HUBER)
        aligned = []
        for n, id in enumerate(frames):
            if id in priors:
                self._align(priors[id], store[id].inverse_depth, flow.curvature[n])
                if priors[id].is_aligned:
                    aligned.append((n, store[id], priors[id]))
        if not aligned:
            return
        rows = [n for n, _, _ in aligned]
        adjusted = adjust_depth(
            store.grid,
            FlowEvidence(flow.curvature[rows], flow.gradient[rows]),
            torch.stack([k.inverse_depth for _, k, _ in aligned]),
            torch.stack([p.inverse_depth for _, _, p in aligned]),
            torch.stack([p.scale for _, _, p in aligned]),
            self.config,
        )
        for n, (_, keyframe, prior) in enumerate(aligned):
            keyframe.inverse_depth = adjusted.inverse_depth[n]
            prior.scale = adjusted.scale[n]
            prior.information = adjusted.information[n] / CAUTION**2

    def _align(
        self, prior: KeyframePrior, inverse_depth: Float[Tensor, "p"], curvature: Float[Tensor, "p"]
    ) -> None:
        """Align a prior to the tracker's unit: once, or again at every call if it has a shift.

        The adjusted scales replace a second alignment of scale.
        """
        if prior.is_aligned and not prior.kind.has_shift:
            return
        relative = curvature * inverse_depth.square()
        weight = relative / (relative + DEVIATION**-2)
        aligned = align_inverse_depth(prior.values, prior.kind, inverse_depth, weight)
        if aligned is not None:
            prior.inverse_depth = aligned
            prior.scale = torch.ones_like(prior.scale)
            prior.is_aligned = True


def add_saved_keyframes(segment: VideoSegment, saved: Sequence[RenderedKeyframe]) -> list[int]:
    """Begin a segment in the gauge of a saved map with fixed keyframes; return their ids.

    The camera is lost there until a frame is recognised at one of them.

    Raises:
        InputError: a keyframe has no image, or one of another camera.
    """
    ids = [_add(segment.keyframes, k, n - len(saved)) for n, k in enumerate(saved)]
    segment.fixed[:] = ids
    segment.final[:] = ids
    segment.status.state = TrackState.LOST
    return ids


def _add(keyframes: KeyframeSet, saved: RenderedKeyframe, frame_index: int) -> int:
    """Add a keyframe with the depth of a saved map; return its id."""
    grid = keyframes.grid
    encode = keyframes.table.encode
    if saved.image is None:
        raise InputError("The map was saved without the images of its keyframes.")
    height, width = saved.image.shape[:2]
    if (width, height) != (grid.camera.width, grid.camera.height):
        raise InputError(
            f"The images of the map are {width} x {height} pixels, those of the video "
            f"{grid.camera.width} x {grid.camera.height}; both have to be of one camera."
        )
    encoded = None if encode is None else encode(saved.image)
    keyframe = keyframes.add(frame_index, saved.timestamp, saved.image, encoded, saved.T_cw)
    inverse_depth, confidence = depth_on_grid(grid, saved)
    information = confidence / (RENDERED_DEVIATION * inverse_depth.clamp(min=1e-6)).square()
    keyframe.inverse_depth = grid_fields(grid).fill(inverse_depth, information)
    keyframe.information = information
    return keyframe.id


def depth_on_grid(
    grid: SampleGrid, saved: RenderedKeyframe
) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"]]:
    """Return inverse depth of the cells and its confidence; both 0 where unknown.

    Inverse depth is linear over the image of a plane, so it is interpolated; not across an edge.
    """
    height, width = saved.depth.shape
    size = grid.pixels.new_tensor([width, height])
    own = grid.pixels.new_tensor([grid.camera.width, grid.camera.height])
    at = (grid.pixels + 0.5) * size / own - 0.5
    low = at.floor().clamp(min=0).minimum(size - 2)
    fraction = (at - low).clamp(0, 1)
    x, y = low.long().unbind(-1)
    depth = saved.depth.to(grid.device)
    weight = saved.weight.to(grid.device)
    corners = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)]
    z = torch.stack([depth[v, u] for u, v in corners], -1)
    trust = torch.stack([weight[v, u] for u, v in corners], -1).amin(-1)
    known = (z > 0).all(-1) & (z.amax(-1) <= ONE_SURFACE * z.amin(-1))
    (a, b), (c, d) = (1 - fraction).unbind(-1), fraction.unbind(-1)
    part = torch.stack([a * b, c * b, a * d, c * d], -1)
    inverse = (part / z.clamp(min=1e-9)).sum(-1)
    return torch.where(known, inverse, 0.0).float(), torch.where(known, trust, 0.0).float()
