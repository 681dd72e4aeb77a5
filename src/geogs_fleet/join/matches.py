"""Matches of a part's keyframes, with each other and with linked parts, kept in files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, Int, Int16
from torch import Tensor

from geogs.application.results.saved_result import SavedResult
from geogs.config import Config
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.loop.keyframe_matches import (
    MATCHED_TOGETHER,
    MAX_DISTANCE,
    PAIRS,
    REMEASURE,
    SUPPRESSION,
)
from geogs.threads import on_one_torch_thread
from geogs.tracking.flow.operator_choice import build_operator
from geogs.tracking.frames.row_errors import RowErrors, edge_shifts
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.graph.proximity import RADIUS, proximity_pairs
from geogs.world.edges import PackedEdge, Pair, in_steps
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeTable
from geogs_fleet.join.links import loaded_keyframes
from geogs_fleet.join.part import Node, Part, PartViews, opened
from geogs_fleet.join.records import read_record, write_record

Directed = tuple[Node, Node]
"""An edge: source and target."""


@dataclass(frozen=True)
class Depths:
    """The depths of a part's keyframes on the grid, in the unit of the joint world."""

    inverse: Float32[Tensor, "n p"]
    information: Float32[Tensor, "n p"]
    """Inverse variances."""
    moving: Bool[Tensor, "n p"]
    """Cells that show something dynamic."""

    def give(self, keyframe: Keyframe, place: int) -> None:
        """Give a keyframe its depths, by its index in the part."""
        keyframe.inverse_depth = self.inverse[place]
        keyframe.information = self.information[place]
        keyframe.moving = self.moving[place]


@dataclass(frozen=True)
class Member:
    """A part at one point of the adjustment."""

    number: int
    part: Part
    views: Path
    T_cw: Float[Tensor, "n 4 4"]
    """Joint world to camera."""
    scale: Float[Tensor, "n"]
    """Divisor of the part's lengths around each keyframe."""
    adjusted: Path | None = None
    """File of its depths; without one, those rendered from its map are used."""

    @property
    def nodes(self) -> list[Node]:
        """All its keyframes."""
        return [(self.number, place) for place in range(len(self.T_cw))]

    def depths(self) -> Depths:
        """Current depths."""
        if self.adjusted is not None:
            return read_record(Depths, self.adjusted)
        views = read_record(PartViews, self.views)
        scale = self.scale.float()[:, None]
        inverse = torch.from_numpy(views.inverse_depth)
        known = torch.from_numpy(views.information)
        return Depths(inverse * scale, known / scale.square(), torch.zeros_like(known).bool())


@dataclass(frozen=True)
class Matches:
    """Directed edges of the frame graph, as arrays of :class:`PackedEdge`."""

    ends: Int[np.ndarray, "e 4"]
    """Source and target: part and index of each."""
    position: Int16[np.ndarray, "e p 2"]
    half_weight: Float16[np.ndarray, "e p 2"]
    poses: Float[np.ndarray, "e 2 4 4"]
    """Poses of source and target at the time of matching."""
    inverse_depth: Float32[np.ndarray, "e p"]
    """Inverse depth of the source at that time."""
    damping: Float32[np.ndarray, "d p"]
    """Damping of the source's depth; empty if the flow gives none."""
    shift: Int16[np.ndarray, "s p 2"]
    """Correction of the positions for the rows of a rolling shutter; empty without one."""

    @staticmethod
    def of(
        edges: Mapping[Directed, PackedEdge], shift: Mapping[Directed, Tensor], cells: int
    ) -> "Matches":
        """Pack edges in order, with the shift of each if there are any."""
        flows = [edges[pair] for pair in sorted(edges)]
        if not flows:
            empty = np.zeros((0, cells), np.float32)
            pixels = np.zeros((0, cells, 2))
            return Matches(
                np.zeros((0, 4), np.int64),
                pixels.astype(np.int16),
                pixels.astype(np.float16),
                np.zeros((0, 2, 4, 4)),
                empty,
                empty,
                pixels.astype(np.int16),
            )
        shifts = [shift[pair].numpy() for pair in sorted(edges)] if shift else []
        damping = [f.damping for f in flows if f.damping is not None]
        return Matches(
            np.array([(*a, *b) for a, b in sorted(edges)], np.int64),
            torch.stack([f.position for f in flows]).numpy(),
            torch.stack([f.half_weight for f in flows]).numpy(),
            torch.stack([torch.stack([f.T_source, f.T_target]) for f in flows]).numpy(),
            torch.stack([f.inverse_depth for f in flows]).numpy(),
            torch.stack(damping).numpy() if damping else np.zeros((0, cells), np.float32),
            np.stack(shifts) if shifts else np.zeros((0, cells, 2), np.int16),
        )

    def edges(self, as_found: bool = False) -> dict[Directed, PackedEdge]:
        """Edges of a graph; ``as_found`` leaves out the shifts."""
        found = {}
        for n, (a, i, b, j) in enumerate(self.ends.tolist()):
            position, weight, poses, depth = (
                torch.from_numpy(x[n])
                for x in (self.position, self.half_weight, self.poses, self.inverse_depth)
            )
            damping = torch.from_numpy(self.damping[n]) if len(self.damping) else None
            if len(self.shift) and not as_found:
                position = position + torch.from_numpy(self.shift[n])
            found[(a, i), (b, j)] = PackedEdge(position, weight, poses[0], poses[1], depth, damping)
        return found


@dataclass(frozen=True)
class Matched:
    """Result of matching a part."""

    ends: Int[np.ndarray, "e 4"]
    """All directed edges."""
    fresh: int
    """Number of newly matched pairs."""


@on_one_torch_thread
def match(
    own: Member,
    others: tuple[Member, ...],
    camera: Camera,
    config: Config,
    before: Sequence[Path],
    after: Sequence[Path],
) -> Matched:
    """Match pairs with near views in both directions, and write the files.

    Args:
        own: a part whose keyframes are matched with each other and with those of others.
        others: linked parts of higher numbers; those of lower numbers match themselves with it.
        camera: of all keyframes.
        config: settings of the matching.
        before: files of earlier matches; only pairs that have moved since are matched again.
        after: files to write: edges that leave its own keyframes, then those of each other part.
    """
    grid = SampleGrid(camera)
    members = (own, *others)
    operator = build_operator(config.tracking, grid)
    segment = KeyframeTable.on(grid, operator.encode).new_set()
    known: dict[Directed, PackedEdge] = {}
    for path in before:
        known |= read_record(Matches, path).edges(as_found=True)
    seen = {node for ends in known for node in ends} if known else _near(own, others)
    ids: dict[Node, int] = {}
    results = {member.number: opened(member.part) for member in members}
    for member in members:
        places = [k for n, k in member.nodes if member is own or (n, k) in seen]
        views = read_record(PartViews, member.views)
        depths = member.depths()
        result = results[member.number]
        loaded = loaded_keyframes(segment, operator, result, views, places, member.T_cw)
        for place, keyframe in loaded.items():
            depths.give(keyframe, place)
            ids[member.number, place] = keyframe.id
    graph = FrameGraph(segment, operator)
    graph.edges.update({(ids[a], ids[b]): edge for (a, b), edge in known.items()})
    pairs = graph.pairs if known else _pairs(graph, len(own.T_cw))
    stale = sorted(graph.stale(pairs, REMEASURE))
    for start in range(0, len(stale), MATCHED_TOGETHER[0]):
        graph.measure(stale[start : start + MATCHED_TOGETHER[0]], packed=True)
    node = {id: n for n, id in ids.items()}
    found = {(node[i], node[j]): e for (i, j), e in graph.packed.items()}
    errors = _row_errors(grid, members, results, ids)
    shift: dict[Directed, Tensor] = {}
    if errors is not None:
        shift = {
            (node[i], node[j]): steps
            for pairs, (off, _) in edge_shifts(errors, segment, graph.packed, lambda id: id)
            for (i, j), steps in zip(pairs, in_steps(grid.camera, off), strict=True)
        }
    ends = []
    for member, path in zip(members, after, strict=True):
        its = {pair: e for pair, e in found.items() if pair[0][0] == member.number}
        leaving = Matches.of(its, shift, grid.size)
        write_record(path, leaving)
        ends.append(leaving.ends)
    return Matched(np.concatenate(ends), len(stale))


def _row_errors(
    grid: SampleGrid,
    members: Sequence[Member],
    results: Mapping[int, SavedResult],
    ids: Mapping[Node, int],
) -> RowErrors | None:
    """Errors of the rectified rows of the keyframes, by the trajectories of their parts.

    None if nothing was rectified. Rows of another camera than the grid's stay unchanged.
    """
    found: RowErrors | None = None
    others = 0
    for member in members:
        result = results[member.number]
        rows = result.rows() if result.camera == grid.camera else {}
        if not rows:
            continue
        trajectory = result.trajectory
        T_wc = trajectory.T_wc.copy()
        T_wc[:, :3, 3] /= float(member.scale.median())
        numbers = list(range(others - len(T_wc), others))  # of frames that are no keyframes
        others -= len(T_wc)
        nearest = np.abs(trajectory.timestamps - result.views.timestamp[:, None]).argmin(1)
        known = {}
        for place, frame in enumerate(nearest.tolist()):
            id = ids.get((member.number, place))
            if id is not None:
                numbers[frame] = id
                if place in rows:
                    known[id] = rows[place]
        own = RowErrors(grid, known, numbers, replace(trajectory, T_wc=T_wc))
        found = own if found is None else found.merged(own)
    return found


def _pairs(graph: FrameGraph, own: int) -> list[Pair]:
    """Pairs within a part, and with others, whose keyframes come after its own."""
    segment = graph.keyframes
    camera = graph.keyframes.grid.camera
    first = segment.ids[:own]
    others = segment.ids[own:]
    limit = MAX_DISTANCE * max(camera.width, camera.height)
    count = PAIRS * own
    found = proximity_pairs(segment, first, first, [], RADIUS, SUPPRESSION, limit, count)
    if others:
        found += proximity_pairs(segment, others, first, [], 0, SUPPRESSION, limit, count)
    return found


def _near(own: Member, others: Sequence[Member]) -> set[Node]:
    """Keyframes of others whose distance to one of its own is less than their median depth."""
    around = _centres(own)
    near = set[Node]()
    for other in others:
        depth = read_record(PartViews, other.views).median_depth / other.scale.numpy()
        away = np.linalg.norm(_centres(other)[:, None] - around, axis=2).min(axis=1)
        near |= {(other.number, int(place)) for place in np.nonzero(away < depth)[0]}
    return near


def _centres(member: Member) -> Float[np.ndarray, "n 3"]:
    T_wc: Tensor = se3_inverse(member.T_cw)
    return np.asarray(T_wc[:, :3, 3].numpy())
