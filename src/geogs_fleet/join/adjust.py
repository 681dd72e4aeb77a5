"""Bundle adjustment of all parts of a world together; each worker has only one part.

The normal equations of a part's poses, its depths eliminated, are small and are summed up here; the
step of all poses goes back to the parts, which update their depths. So it is one adjustment of
everything, whose matches and depths stay in files.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.camera_system import PoseSums, SparseCameraSystem
from geogs.bundle.dense import FLOOR
from geogs.bundle.device_choice import grid_fields
from geogs.bundle.schur import stepped_depths
from geogs.bundle.streamed import StreamedSchur
from geogs.bundle.terms import BundleState
from geogs.config import Config
from geogs.geometry.camera import Camera
from geogs.geometry.least_squares import Step, minimise
from geogs.geometry.lie import move
from geogs.loop.keyframe_matches import CONVERGED, GLOBAL_OPTIONS, ROUNDS
from geogs.threads import on_one_torch_thread
from geogs.tracking.flow.operator_choice import build_operator
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.world.edges import PackedEdge
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from geogs_fleet.join.gauge import Gauge
from geogs_fleet.join.matches import Depths, Directed, Matches, Member, match
from geogs_fleet.join.part import Node, Part
from geogs_fleet.join.part_graph import Placement
from geogs_fleet.join.records import read_record, write_record
from geogs_fleet.workers import Workers

_NO_IMAGE = np.zeros((1, 1, 3), np.uint8)
"""Image of a keyframe whose matches are known."""


def adjusted(
    parts: Sequence[Part],
    files: Sequence[Path],
    placements: Mapping[int, Placement],
    gauge: Gauge,
    camera: Camera,
    config: Config,
    workers: Workers,
    folder: Path,
) -> dict[int, Placement]:
    """Adjust the keyframes of a world by all matches within its parts and between linked ones.

    The first keyframe of the first part is fixed. Depths and matches are kept in ``folder``, which
    all workers can access.
    """
    now = {
        n: Member(n, parts[n], files[n], placements[n].T_cw, placements[n].scale)
        for n in gauge.parts
    }
    adjustment = _Adjustment(now, gauge.linked, camera, config, workers, folder)
    folder.mkdir(parents=True, exist_ok=True)
    for _ in range(ROUNDS):
        if not adjustment.match():
            break
        adjustment.solve()
    return {n: replace(placements[n], T_cw=member.T_cw) for n, member in adjustment.members.items()}


@dataclass(frozen=True)
class _Poses:
    """The poses of all keyframes, and the last step, which the depths have not followed yet."""

    T_cw: Float[Tensor, "m 4 4"]
    before: Float[Tensor, "m 4 4"] | None = None
    step: Float[Tensor, "m 6"] | None = None


class _Adjustment:
    """State between two steps."""

    def __init__(
        self,
        members: dict[int, Member],
        linked: Mapping[int, list[int]],
        camera: Camera,
        config: Config,
        workers: Workers,
        folder: Path,
    ) -> None:
        self.members = members
        self.linked = linked
        self.folder = folder
        self.camera = camera
        self.config = config
        self.workers = workers
        counts = np.cumsum([0, *(len(m.T_cw) for m in members.values())]).tolist()
        self.first = dict(zip(members, counts[:-1], strict=True))
        self.matches: dict[tuple[int, int], Path] = {}
        """Files of the edges that leave the keyframes of the second part, matched by the first."""
        self.ends = np.zeros((0, 4), np.int64)
        self.steps = 0
        """Number of steps of all poses so far."""
        self.numbers = itertools.count(1)
        """Numbers of the files, so that each gets a unique name."""

    def match(self) -> bool:
        """Match the pairs that have moved; return whether enough have for another adjustment."""
        jobs = []
        written = []
        for n, own in self.members.items():
            later = [m for m in self.linked[n] if m > n]
            paths = {(n, m): self._new(f"matches-{n}-{m}") for m in (n, *later)}
            before = tuple(self.matches[key] for key in paths if key in self.matches)
            others = tuple(self.members[m] for m in later)
            jobs.append((own, others, self.camera, self.config, before, tuple(paths.values())))
            written.append(paths)
        found = self.workers.map("matching", match, jobs)
        for path in self.matches.values():
            path.unlink()
        self.matches = {key: path for paths in written for key, path in paths.items()}
        self.ends = np.concatenate([f.ends for f in found])
        return sum(f.fresh for f in found) > CONVERGED * (len(self.ends) // 2)

    def solve(self) -> None:
        """Take Gauss-Newton steps until they are small, then update the depths."""
        T_cw = torch.cat([member.T_cw for member in self.members.values()])
        problem = _AllPoses(self, torch.arange(len(T_cw)) > 0)
        # The cost after a step is not evaluated: that would need another pass over all files.
        found = minimise(_Poses(T_cw), problem.linearise, problem.step, GLOBAL_OPTIONS.policy)
        if found.finite:
            self.follow(found.state, is_last=True)

    def ends_of_edges(self) -> tuple[Int[Tensor, "e"], Int[Tensor, "e"]]:
        """Indices of sources and targets among all keyframes, sorted by source."""
        first = np.zeros(max(self.first) + 1, np.int64)
        first[list(self.first)] = list(self.first.values())
        source, target = (first[self.ends[:, k]] + self.ends[:, k + 1] for k in (0, 2))
        order = np.argsort(source, kind="stable")
        return torch.from_numpy(source[order]), torch.from_numpy(target[order])

    def place(self, T_cw: Float[Tensor, "m 4 4"]) -> None:
        """Set the poses of all keyframes."""
        self.members = {
            n: replace(m, T_cw=T_cw[self.first[n] :][: len(m.T_cw)])
            for n, m in self.members.items()
        }

    def follow(self, poses: "_Poses", is_last: bool = False) -> list[PoseSums | None]:
        """Update the depths after a step; return the parts' equations for the next one."""
        jobs = []
        files = {n: self._new(f"depths-{n}") for n in self.members}
        for n, own in self.members.items():
            others = tuple(self.members[m] for m in self.linked[n])
            leaving = tuple(path for (_, m), path in self.matches.items() if m == n)
            first = {m: self.first[m] for m in (n, *self.linked[n])}
            jobs.append(
                (own, others, first, leaving, self.camera, self.config, files[n], poses, is_last)
            )
        self.steps += poses.step is not None
        equations = self.workers.map(f"adjusting, {self.steps} steps", follow, jobs)
        for n, own in self.members.items():
            if own.adjusted is not None:
                own.adjusted.unlink()
            self.members[n] = replace(own, adjusted=files[n])
        return equations

    def _new(self, name: str) -> Path:
        """A new file for a job's output: a repeated job finds the same input as the first time."""
        return self.folder / f"{name}-{next(self.numbers)}.safetensors"


class _AllPoses:
    """The least-squares problem of all poses; the parts keep the depths."""

    def __init__(self, adjustment: _Adjustment, free: Bool[Tensor, "m"]) -> None:
        self.adjustment = adjustment
        self.system = SparseCameraSystem(*adjustment.ends_of_edges(), free)

    def linearise(self, state: _Poses) -> SparseCameraSystem:
        """Update the depths of all parts after the last step; sum up their equations."""
        self.system.clear()
        for sums in self.adjustment.follow(state):
            if sums is not None:
                self.system.add_elsewhere_summed(sums)
        return self.system

    def step(
        self, state: _Poses, linear: SparseCameraSystem, damping: float
    ) -> Step[_Poses] | None:
        """Take one step of the least-squares loop; the parts' keyframes get the new poses."""
        found = linear.solve(damping, FLOOR)
        if found is None:
            return None
        xi = found.reshape(-1, 6)
        moved = move(xi, state.T_cw)
        self.adjustment.place(moved)
        return Step(_Poses(moved, state.T_cw, xi), float(xi.abs().max()))


@on_one_torch_thread
def follow(
    member: Member,
    others: tuple[Member, ...],
    first: Mapping[int, int],
    matches: tuple[Path, ...],
    camera: Camera,
    config: Config,
    after: Path,
    poses: _Poses,
    is_last: bool,
) -> PoseSums | None:
    """Update the depths of a part after a step and write them; return its next equations.

    These use the indices among all keyframes; none after the last step.

    Args:
        member: the part.
        others: all parts with links to it.
        first: index of the first keyframe of each part among all keyframes.
        matches: files of the edges whose source is one of its keyframes.
        camera: of all keyframes.
        config: settings of the matching.
        after: file to write the depths to.
        poses: of all keyframes, with their last step, if there was one.
        is_last: form no further equations; fill cells without matches, and find dynamic cells.
    """
    grid = SampleGrid(camera)
    graph, nodes = _known_graph(member, others, matches, config, grid)
    own = graph.keyframes.ids[: len(member.T_cw)]
    problem, ids = graph.streamed_problem(list(graph.edges), [], own)
    problem = replace(problem, free_pose=torch.ones(len(ids), dtype=torch.bool))
    schur = StreamedSchur(problem, grid, GLOBAL_OPTIONS)
    numbers = torch.tensor([first[part] + place for part, place in (nodes[k] for k in ids)])
    d = problem.inverse_depth
    if poses.step is not None and poses.before is not None:
        before = BundleState(poses.before[numbers], d)
        step = poses.step[numbers]
        delta = schur.depth_steps(before, schur.system, step.reshape(-1))
        d = stepped_depths(problem, d + delta)
    information = graph.keyframes.informations(own)
    sums: PoseSums | None = None
    if not is_last:
        schur.add_matches(BundleState(problem.T_cw, d))
        sources = torch.unique(problem.source)
        information[sources] = schur.information[sources]
        sums = schur.system.sums(numbers)
    depth = d[: len(own)]
    if is_last:
        depth = grid_fields(grid).fill(depth, information)
        for id, field in zip(own, depth, strict=True):
            graph.keyframes[id].inverse_depth = field
        graph.update_dynamic(set(own), config.tracking.moving)
    none = torch.zeros(grid.size, dtype=torch.bool)
    moving = [graph.keyframes[id].moving for id in own]
    held = torch.stack([none if m is None else m for m in moving])
    write_record(after, Depths(depth.contiguous(), information, held))
    return sums


def _known_graph(
    own: Member,
    others: tuple[Member, ...],
    matches: tuple[Path, ...],
    config: Config,
    grid: SampleGrid,
) -> tuple[FrameGraph, list[Node]]:
    """Graph of the edges that leave a part's keyframes, which come first; all keyframes' nodes."""
    edges: dict[Directed, PackedEdge] = {}
    for path in matches:
        edges |= read_record(Matches, path).edges()
    seen = {target for _, target in edges}
    segment = KeyframeTable.on(grid).new_set()
    nodes: list[Node] = []
    ids: dict[Node, int] = {}
    for member in (own, *others):
        depths = member.depths()
        for node in member.nodes:
            if member is not own and node not in seen:
                continue
            place = node[1]
            keyframe = segment.add(place, float(place), _NO_IMAGE, None, member.T_cw[place])
            depths.give(keyframe, place)
            ids[node] = keyframe.id
            nodes.append(node)
    graph = FrameGraph(segment, build_operator(config.tracking, grid))
    graph.edges.update({(ids[a], ids[b]): edge for (a, b), edge in edges.items()})
    return graph, nodes
