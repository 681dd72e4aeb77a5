"""The frame graph: pairs of covisible keyframes, and the flow measured between them."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.device_choice import (
    bundle_solver,
    grid_fields,
    keyframe_pairs,
    large_bundle_solver,
)
from geogs.bundle.problem import BundleProblem, StreamedProblem
from geogs.bundle.projection import project
from geogs.bundle.protocols import BundleOptions, BundleResult
from geogs.bundle.terms import DepthDamping, MeasuredDepths
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.threads import thread_map
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.graph.dynamic_cells import static_weight, update_dynamic
from geogs.tracking.graph.measured_odometry import Odometry
from geogs.tracking.graph.proximity import PAIRS_TOGETHER
from geogs.types import FlowMatch
from geogs.world.cell_depths import MeasuredCells
from geogs.world.edges import Edge, MeasuredEdge, PackedEdge, Pair, edge_matches, pack_matches
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeSet

HUBER = 0.5
"""Huber threshold in standard deviations of the flow, which are overestimated."""
STACKED_EDGES = 1024, 8192
"""Most directed edges of an adjustment with all matches in one tensor, on CPU and GPU."""
FARTHER, NEAREST = 0.75, 2.5
"""Quantile of a keyframe's inverse depth, and the multiple of it above which influence grows no
more: three medians in a room, four and a half on a street."""
LEAST = 0.01
"""Least factor on a weight: before a far background only near cells determine the translation."""


class FrameGraph:
    """Pairs of keyframes with their flow in both directions."""

    def __init__(
        self,
        keyframes: KeyframeSet,
        operator: FlowOperator,
        odometry: Odometry | None = None,
        edges: dict[Pair, Edge] | None = None,
    ) -> None:
        """``odometry``, if any, takes part in adjustments; ``edges`` are those already measured,
        and are changed in place."""
        self.keyframes = keyframes
        self.odometry = odometry
        self.operator = operator
        self.edges: dict[Pair, Edge] = {} if edges is None else edges
        self.bundle = bundle_solver(keyframes.grid)

    def see_by(self, camera: Camera) -> None:
        """Assume another camera for matches and depths."""
        self.keyframes.table.see_by(camera)
        self.bundle = bundle_solver(self.keyframes.grid)

    @property
    def pairs(self) -> list[Pair]:
        """Measured pairs."""
        return [(i, j) for i, j in self.edges if i < j]

    @property
    def packed(self) -> dict[Pair, PackedEdge]:
        """Packed edges."""
        return {pair: e for pair, e in self.edges.items() if isinstance(e, PackedEdge)}

    def remove_keyframe(self, id: int) -> None:
        """Remove every edge of a keyframe."""
        for directed in [e for e in self.edges if id in e]:
            del self.edges[directed]

    def retire(self, keep: Collection[int], least: int = 1) -> dict[Pair, Edge]:
        """Remove and return the edges that join none of the given keyframes.

        Nothing is removed if they are fewer than ``least``.
        """
        kept = set(keep)
        old = {e: v for e, v in self.edges.items() if e[0] not in kept and e[1] not in kept}
        if len(old) < least:
            return {}
        for directed in old:
            del self.edges[directed]
        return old

    def replace(self, edges: Mapping[Pair, Edge]) -> None:
        """Replace all edges."""
        edges = dict(edges)
        self.edges.clear()
        self.edges.update(edges)

    def reprojections(self, directed: Sequence[Pair]) -> Float[Tensor, "e p 2"]:
        """Return present positions of the cells of i in j for each directed edge (i, j)."""
        return keyframe_pairs(self.keyframes, directed).project()

    def measure(self, pairs: Iterable[Pair], fine: bool = True, packed: bool = False) -> None:
        """Measure the flow of pairs in both directions, starting from the reprojection.

        ``packed`` edges take a third of the memory.
        """
        pairs = list(pairs)
        if not pairs:
            return
        first, second = ([self.keyframes[p[k]].encoded for p in pairs] for k in (0, 1))
        both = self.reprojections(pairs + [(j, i) for i, j in pairs])
        forward = both[: len(pairs)]
        backward = both[len(pairs) :]
        memory = [(self._memory((i, j)), self._memory((j, i))) for i, j in pairs]
        there, back = self.operator.measure(
            first, second, forward, backward, fine=fine, memory=memory
        )
        if packed:
            self._keep_packed(pairs, there)
            self._keep_packed([(j, i) for i, j in pairs], back)
            return
        for n, (i, j) in enumerate(pairs):
            self.edges[i, j] = _edge_of(there, n, forward[n])
            self.edges[j, i] = _edge_of(back, n, backward[n])

    def _keep_packed(self, directed: Sequence[Pair], match: FlowMatch) -> None:
        """Store a measurement that started from the present state."""
        position, half_weight = pack_matches(self.keyframes.grid, match.pixels, match.weight)
        for n, (i, j) in enumerate(directed):
            source = self.keyframes[i]
            target = self.keyframes[j]
            self.edges[i, j] = PackedEdge(
                position[n],
                half_weight[n],
                source.T_cw,
                target.T_cw,
                source.inverse_depth,
                None if match.damping is None else match.damping[n],
                None if match.memory is None else match.memory[n],
            )

    def _memory(self, directed: Pair) -> Any:
        edge = self.edges.get(directed)
        return None if edge is None else edge.memory

    def release(self, moving: Collection[int]) -> None:
        """Free the flow operator's cache of edges that do not join a moving keyframe."""
        for directed, edge in self.edges.items():
            if directed[0] not in moving and directed[1] not in moving:
                edge.memory = None

    def stale(self, pairs: Sequence[Pair], tolerance: float) -> list[Pair]:
        """Return pairs that are new or whose reprojection has moved by more than ``tolerance``.

        It is in pixels: the median over the matched cells, of the direction that moved more.
        """
        known = [p for p in pairs if p in self.edges]
        new = [p for p in pairs if p not in self.edges]
        if not known:
            return new
        moved = self._moved(known + [(j, i) for i, j in known]).cpu().nan_to_num(torch.inf)
        worst = torch.maximum(*moved.split(len(known)))
        return new + [p for p, m in zip(known, worst.tolist(), strict=True) if m > tolerance]

    def _moved(self, directed: Sequence[Pair]) -> Float[Tensor, "e"]:
        """Return the median motion in pixels of the matched cells since they were measured; in
        parts, concurrently on the CPU."""
        grid = self.keyframes.grid

        def moved(part: Sequence[Pair]) -> Float[Tensor, "k"]:
            edges = [self.edges[e] for e in part]
            _, weight = edge_matches(grid, edges)
            return keyframe_pairs(self.keyframes, part).moved(_reprojections(grid, edges), weight)

        size = PAIRS_TOGETHER[grid.on_gpu]
        parts = [directed[k : k + size] for k in range(0, len(directed), size)]
        return torch.cat([moved(p) for p in parts] if grid.on_gpu else thread_map(moved, parts))

    def problem(
        self, directed: Sequence[Pair], free_pose: Iterable[int], free_depth: Iterable[int]
    ) -> tuple[BundleProblem, list[int]]:
        """Return the adjustment of the given edges, and the keyframe id of each of its frames."""
        problem, ids = self.streamed_problem(directed, free_pose, free_depth)
        return problem.part(slice(None)), ids

    def streamed_problem(
        self, directed: Sequence[Pair], free_pose: Iterable[int], free_depth: Iterable[int]
    ) -> tuple[StreamedProblem, list[int]]:
        """Return the same as :meth:`problem`, with matches read in parts."""
        directed = sorted(directed)
        poses = set(free_pose)
        depths = set(free_depth)
        ids = sorted({k for e in directed for k in e} | poses | depths)
        slot = {k: n for n, k in enumerate(ids)}
        edges = [self.edges[e] for e in directed]

        def matches(part: slice) -> tuple[Tensor, Tensor]:
            pixels, weight = edge_matches(self.keyframes.grid, edges[part])
            return pixels, static_weight(self.keyframes, directed[part], pixels, weight)

        depth_terms = (
            _frame_damping(edges, [slot[i] for i, _ in directed], len(ids)),
            _measured([self.keyframes[k] for k in ids]),
        )
        motions = None if self.odometry is None else self.odometry.between(ids)
        problem = StreamedProblem(
            T_cw=self.keyframes.poses(ids),
            inverse_depth=self.keyframes.inverse_depths(ids),
            source=torch.tensor([slot[i] for i, _ in directed], dtype=torch.long),
            target=torch.tensor([slot[j] for _, j in directed], dtype=torch.long),
            matches=matches,
            free_pose=torch.tensor([k in poses for k in ids]),
            free_depth=torch.tensor([k in depths for k in ids]),
            depth_terms=tuple(term for term in depth_terms if term is not None),
            pose_terms=() if motions is None else (motions,),
        )
        return problem, ids

    def update_dynamic(self, ids: Collection[int], threshold: float) -> None:
        """Update the dynamic cells of some keyframes by all their edges (:func:`update_dynamic`).

        A threshold of 0 changes nothing.
        """
        if threshold > 0:
            decided = [e for e in self.edges if e[0] in ids]
            update_dynamic(self.keyframes, self.edges, decided, threshold)

    def adjust(
        self,
        directed: Sequence[Pair],
        free_pose: Sequence[int],
        free_depth: Sequence[int],
        options: BundleOptions,
        bounded: bool = False,
    ) -> BundleResult | None:
        """Solve for poses and inverse depths and store them; None (nothing stored) on failure.

        With ``bounded`` the influence of very near cells is limited (:func:`solve_bounded`).
        """
        if not directed:
            return None
        problem, ids = self.streamed_problem(directed, free_pose, free_depth)
        if bounded:
            result = solve_bounded(problem, self._solve, options)
        else:
            result = self._solve(problem, options)
        if not result.finite:
            return None
        depths = set(free_depth)
        poses = set(free_pose)
        for n, k in enumerate(ids):
            if k in poses:
                self.keyframes[k].T_cw = result.T_cw[n]
        rows = [n for n, k in enumerate(ids) if k in depths]
        if rows:
            depth = torch.stack([result.inverse_depth[n] for n in rows])
            information = torch.stack([result.information[n] for n in rows])
            filled = grid_fields(self.keyframes.grid).fill(depth, information)
            for m, n in enumerate(rows):
                keyframe = self.keyframes[ids[n]]
                # Copies: a row would keep the whole stack in memory.
                keyframe.inverse_depth = filled[m].clone()
                keyframe.information = information[m].clone()
        return result

    def _solve(self, problem: StreamedProblem, options: BundleOptions) -> BundleResult:
        grid = self.keyframes.grid
        if len(problem.source) <= STACKED_EDGES[grid.on_gpu]:
            return self.bundle.solve(problem.part(slice(None)), options)
        return large_bundle_solver(grid).solve(problem, options)


def _measured(keyframes: Sequence[Keyframe]) -> MeasuredDepths | None:
    """Return sensor depths of keyframes' cells; None where no keyframe has any."""
    if all(k.measured is None for k in keyframes):
        return None
    zero = torch.zeros_like(keyframes[0].inverse_depth)
    cells = [k.measured or MeasuredCells(zero, zero) for k in keyframes]
    inverse_depth = torch.stack([c.inverse_depth for c in cells])
    return MeasuredDepths(inverse_depth, torch.stack([c.information for c in cells]))


def _edge_of(match: FlowMatch, n: int, reprojection: Float[Tensor, "p 2"]) -> MeasuredEdge:
    """Return the n-th edge of a measurement."""
    damping = None if match.damping is None else match.damping[n]
    memory = None if match.memory is None else match.memory[n]
    return MeasuredEdge(match.pixels[n], match.weight[n], reprojection, damping, memory)


def _reprojections(grid: SampleGrid, edges: Sequence[Edge]) -> Float[Tensor, "e p 2"]:
    """Return reprojections of the cells when the flow of each edge was measured."""
    packed = [e for e in edges if isinstance(e, PackedEdge)]
    if packed and len(packed) == len(edges):
        return _packed_reprojections(grid, packed)
    return torch.stack(
        [
            e.reprojection if isinstance(e, MeasuredEdge) else _packed_reprojections(grid, [e])[0]
            for e in edges
        ]
    )


def _packed_reprojections(grid: SampleGrid, edges: Sequence[PackedEdge]) -> Float[Tensor, "e p 2"]:
    """Compute them for packed edges, by the poses and depths of that time."""
    source, target = (torch.stack([getattr(e, k) for e in edges]) for k in ("T_source", "T_target"))
    depth = torch.stack([e.inverse_depth for e in edges])
    return project(grid.camera, grid.rays, target @ se3_inverse(source), depth).pixels


def _frame_damping(
    edges: Sequence[Edge], source: Sequence[int], frames: int
) -> DepthDamping | None:
    """Return the mean damping of each frame over its outgoing edges; None where there is none."""
    given = [(e.damping, n) for e, n in zip(edges, source, strict=True) if e.damping is not None]
    if not given:
        return None
    count = torch.bincount(torch.tensor([n for _, n in given]), minlength=frames)
    total = torch.zeros(frames, given[0][0].shape[0], device=given[0][0].device)
    for start in range(0, len(given), STACKED_EDGES[0]):
        part = given[start : start + STACKED_EDGES[0]]
        damping = torch.stack([d for d, _ in part])
        mean = torch.nn.functional.one_hot(torch.tensor([n for _, n in part]), frames).float()
        mean = mean / count.clamp(min=1)
        total = total + mean.mT.to(damping) @ damping
    return DepthDamping(total)


def bounded_influence(inverse_depth: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
    """Return factors on the weights of matches, by the inverse depths of their cells.

    One up to ``NEAREST`` times the usual inverse depth; beyond, the influence on a translation is
    constant (a Mallows estimator: the bound depends on where a measurement was taken, not on how
    it fits). ``LEAST`` at least.
    """
    rank = 1 + int(FARTHER * (inverse_depth.shape[1] - 1))
    usual = inverse_depth.kthvalue(rank, 1, keepdim=True).values
    return (NEAREST * usual / inverse_depth.clamp(min=1e-9)).clamp(max=1).square().clamp(min=LEAST)


def solve_bounded(
    problem: StreamedProblem,
    solve: Callable[[StreamedProblem, BundleOptions], BundleResult],
    options: BundleOptions,
) -> BundleResult:
    """Solve with bounded influence of near cells, then for the depths alone without a bound: only
    the influence on poses has to be limited, not that on a cell's own depth.

    The effect of a match on the translation is proportional to the cell's inverse depth, and its
    weight in the normal equations to the square. An object that moves across a nearly static view
    looks very near, gets a large influence, and can pull the camera's motion until it fits; then it
    can no longer be detected. Once dynamic cells are detected, near cells may count in full.
    """
    influence = bounded_influence(problem.inverse_depth)
    if bool((influence == 1).all()):
        return solve(problem, options)

    def matches(part: slice) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]:
        pixels, weight = problem.matches(part)
        source = problem.source[part].to(influence.device)
        return pixels, weight * influence[source][..., None]

    found = solve(replace(problem, matches=matches), options)
    none = torch.zeros_like(problem.free_pose)
    held = replace(
        problem, T_cw=found.T_cw, inverse_depth=found.inverse_depth, free_pose=none, pose_terms=()
    )
    of_depths = solve(held, replace(options, iterations=1))
    return replace(of_depths, finite=found.finite and of_depths.finite)
