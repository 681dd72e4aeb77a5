"""The frame graph: which keyframes see each other, and the flow measured between them."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.tracking.bundle import (
    BundleOptions,
    BundleProblem,
    BundleResult,
    bundle_solver,
    project,
    relative_motion,
)
from geogs.tracking.flow.base import FlowMatch, FlowOperator
from geogs.tracking.keyframes import KeyframeStore

Pair = tuple[int, int]
"""Two keyframe ids, the earlier first; an edge of the graph in both directions."""


@dataclass
class Edge:
    """One direction of a measured pair."""

    pixels: Float[Tensor, "p 2"]
    weight: Float[Tensor, "p 2"]
    reprojection: Float[Tensor, "p 2"]
    """Where the cells fell when the flow was measured."""
    damping: Float[Tensor, "p"] | None = None
    """Of the source's inverse depth, if the operator gives one."""
    memory: Any = None
    """What the operator keeps of this edge."""

    @staticmethod
    def of(match: FlowMatch, n: int, reprojection: Float[Tensor, "p 2"]) -> "Edge":
        """The n-th edge of a measurement."""
        damping = None if match.damping is None else match.damping[n]
        memory = None if match.memory is None else match.memory[n]
        return Edge(match.pixels[n], match.weight[n], reprojection, damping, memory)


class FrameGraph:
    """Pairs of keyframes with their flow in both directions."""

    def __init__(self, keyframes: KeyframeStore, operator: FlowOperator) -> None:
        self.keyframes = keyframes
        self.operator = operator
        self.edges: dict[Pair, Edge] = {}
        self.bundle = bundle_solver(keyframes.grid)

    @property
    def pairs(self) -> list[Pair]:
        """Measured pairs."""
        return [(i, j) for i, j in self.edges if i < j]

    def remove_keyframe(self, id: int) -> None:
        """Forget every edge of a keyframe."""
        self.edges = {e: v for e, v in self.edges.items() if id not in e}

    def reprojections(self, directed: Sequence[Pair]) -> Float[Tensor, "e p 2"]:
        """Present positions of the cells of i in j for each directed edge (i, j)."""
        if not directed:
            return self.keyframes.grid.pixels.new_zeros(0, self.keyframes.grid.size, 2)
        store = self.keyframes
        if store.grid.on_gpu:
            from geogs.tracking.cuda.graph import DirectedPairs

            return DirectedPairs.of(store, directed).project()
        source, target = (store.poses([e[k] for e in directed]) for k in (0, 1))
        index = torch.arange(len(directed), device=source.device)
        T = relative_motion(torch.cat([source, target]), index, index + len(directed))
        grid = store.grid
        return project(
            grid.camera, grid.rays, T, store.inverse_depths([e[0] for e in directed])
        ).pixels

    def measure(self, pairs: Iterable[Pair], cold: bool = False, fine: bool = True) -> None:
        """Measure the flow of pairs in both directions, starting from the reprojection."""
        pairs = list(pairs)
        if not pairs:
            return
        first, second = ([self.keyframes[p[k]].encoded for p in pairs] for k in (0, 1))
        both = self.reprojections(pairs + [(j, i) for i, j in pairs])
        forward, backward = both[: len(pairs)], both[len(pairs) :]
        if cold:
            there, back = self.operator.measure(first, second, fine=fine)
        else:
            memory = [(self._memory((i, j)), self._memory((j, i))) for i, j in pairs]
            there, back = self.operator.measure(
                first, second, forward, backward, fine=fine, memory=memory
            )
        for n, (i, j) in enumerate(pairs):
            self.edges[i, j] = Edge.of(there, n, forward[n])
            self.edges[j, i] = Edge.of(back, n, backward[n])

    def _memory(self, directed: Pair) -> Any:
        edge = self.edges.get(directed)
        return None if edge is None else edge.memory

    def release(self, moving: Collection[int]) -> None:
        """Let go of what the operator keeps of edges that do not join a moving keyframe."""
        for directed, edge in self.edges.items():
            if directed[0] not in moving and directed[1] not in moving:
                edge.memory = None

    def stale(self, pairs: Sequence[Pair], tolerance: float) -> list[Pair]:
        """Pairs that are new or whose reprojection has moved more than ``tolerance`` pixels.

        The median over the matched cells of the direction that moved more counts.
        """
        known = [p for p in pairs if p in self.edges]
        new = [p for p in pairs if p not in self.edges]
        if not known:
            return new
        directed = known + [(j, i) for i, j in known]
        moved = self._moved(directed).cpu().nan_to_num(torch.inf)
        worst = torch.maximum(*moved.split(len(known)))
        return new + [p for p, m in zip(known, worst.tolist(), strict=True) if m > tolerance]

    def _moved(self, directed: Sequence[Pair]) -> Float[Tensor, "e"]:
        """Median motion in pixels of the matched cells since they were measured."""
        before = torch.stack([self.edges[e].reprojection for e in directed])
        weight = torch.stack([self.edges[e].weight for e in directed])
        if self.keyframes.grid.on_gpu:
            from geogs.tracking.cuda.graph import DirectedPairs

            return DirectedPairs.of(self.keyframes, directed).moved(before, weight)
        moved = (self.reprojections(directed) - before).norm(dim=-1)
        return moved.masked_fill(~(weight[..., 0] > 0), torch.nan).nanmedian(dim=1).values

    def problem(
        self, directed: Sequence[Pair], free_pose: Iterable[int], free_depth: Iterable[int]
    ) -> tuple[BundleProblem, list[int]]:
        """The adjustment of the given edges, and the keyframe id of each of its frames."""
        directed = sorted(directed)
        poses, depths = set(free_pose), set(free_depth)
        ids = sorted({k for e in directed for k in e} | poses | depths)
        slot = {k: n for n, k in enumerate(ids)}
        edges = [self.edges[e] for e in directed]
        problem = BundleProblem(
            T_cw=self.keyframes.poses(ids),
            inverse_depth=self.keyframes.inverse_depths(ids),
            source=torch.tensor([slot[i] for i, _ in directed]),
            target=torch.tensor([slot[j] for _, j in directed]),
            pixels=torch.stack([e.pixels for e in edges]),
            weight=torch.stack([e.weight for e in edges]),
            free_pose=torch.tensor([k in poses for k in ids]),
            free_depth=torch.tensor([k in depths for k in ids]),
            damping=_frame_damping(edges, [slot[i] for i, _ in directed], len(ids)),
        )
        return problem, ids

    def adjust(
        self,
        directed: Sequence[Pair],
        free_pose: Sequence[int],
        free_depth: Sequence[int],
        options: BundleOptions,
    ) -> BundleResult | None:
        """Solve for poses and inverse depths and store them; None (nothing stored) on failure."""
        if not directed:
            return None
        problem, ids = self.problem(directed, free_pose, free_depth)
        result = self.bundle.solve(problem, options)
        if not result.finite:
            return None
        depths, poses = set(free_depth), set(free_pose)
        for n, k in enumerate(ids):
            if k in poses:
                self.keyframes[k].T_cw = result.T_cw[n]
        rows = [n for n, k in enumerate(ids) if k in depths]
        if rows:
            depth = torch.stack([result.inverse_depth[n] for n in rows])
            information = torch.stack([result.information[n] for n in rows])
            filled = self.keyframes.grid.fill_all(depth, information)
            for m, n in enumerate(rows):
                state = self.keyframes[ids[n]]
                state.inverse_depth, state.information = filled[m], information[m]
        return result


def _frame_damping(
    edges: Sequence[Edge], source: Sequence[int], frames: int
) -> Float[Tensor, "n p"] | None:
    """Damping of each frame: the mean over the edges that leave it; None where there is none."""
    given = [(e.damping, n) for e, n in zip(edges, source, strict=True) if e.damping is not None]
    if not given:
        return None
    place = torch.tensor([n for _, n in given])
    share = torch.nn.functional.one_hot(place, frames).float()
    share = share / share.sum(0).clamp(min=1)
    damping = torch.stack([d for d, _ in given])
    return share.mT.to(damping) @ damping


def frame_distances(
    store: KeyframeStore, directed: Sequence[Pair], rotation_weight: float = 0.3, step: int = 2
) -> Float[Tensor, "e"]:
    """DROID-SLAM's distance of directed keyframe pairs in pixels; infinite at little overlap.

    Mean of the flow (weight ``rotation_weight``) and of the flow without the rotation (the rest)
    over the cells that stay in front of the target; infinite where less than 3/4 do or where less
    than a fifth falls into the image.
    """
    grid = store.grid
    if not directed:
        return grid.pixels.new_zeros(0)
    if grid.on_gpu:
        from geogs.tracking.cuda.graph import DirectedPairs

        return DirectedPairs.of(store, directed).distances(rotation_weight, step)
    keep = torch.zeros(grid.height, grid.width, dtype=torch.bool, device=grid.device)
    keep[::step, ::step] = True
    keep = keep.reshape(-1)
    rays, pixels = grid.rays[keep], grid.pixels[keep]
    source, target = (store.poses([e[k] for e in directed]) for k in (0, 1))
    index = torch.arange(len(directed), device=source.device)
    T = relative_motion(torch.cat([source, target]), index, index + len(directed))
    d = store.inverse_depths([e[0] for e in directed])[:, keep]
    shift = T.clone()
    shift[:, :3, :3] = torch.eye(3, dtype=T.dtype, device=T.device)
    total = valid = inside = torch.zeros(len(directed), device=T.device)
    for motion, share in ((T, rotation_weight), (shift, 1 - rotation_weight)):
        p = project(grid.camera, rays, motion, d)
        flow = (p.pixels - pixels).norm(dim=-1)
        total = total + share * (flow * p.valid).sum(1)
        valid = valid + share * p.valid.float().sum(1)
        if motion is T:
            inside = (grid.inside(p.pixels) & p.valid).float().mean(1)
    seen = (valid > 0.75 * int(keep.sum())) & (inside > 0.2)
    return torch.where(seen, total / valid.clamp(min=1e-6), torch.inf)


def proximity_pairs(
    store: KeyframeStore,
    later: Sequence[int],
    earlier: Sequence[int],
    existing: Iterable[Pair],
    radius: int,
    suppression: int,
    max_distance: float,
    max_pairs: int,
) -> list[Pair]:
    """Pairs to add between ``later`` and ``earlier`` keyframes (DROID-SLAM's proximity factors).

    Every later keyframe is paired with its ``radius`` predecessors; then pairs are taken by growing
    distance up to ``max_distance`` pixels, each suppressing those within ``suppression`` keyframes
    of it, as the existing pairs do, until ``max_pairs`` are found.
    """
    position = {k: n for n, k in enumerate(store.ids)}
    ids = store.ids
    # Pairs that end well before the later keyframes suppress none of theirs.
    reach = min((position[k] for k in later), default=0) - suppression
    taken = {
        (position[i], position[j])
        for i, j in existing
        if i in position and j in position and position[j] >= reach
    }
    found: list[Pair] = []
    for k in later:
        for back in range(1, radius + 1):
            pair = (position[k] - back, position[k])
            if pair[0] >= 0 and pair not in taken:
                taken.add(pair)
                found.append(pair)
    blocked = {cell for pair in taken for cell in _neighbourhood(pair, suppression)}
    candidates = [
        (a, b)
        for a in sorted(position[k] for k in earlier)
        for b in sorted(position[k] for k in later)
        if b - a > radius and (a, b) not in blocked
    ]
    directed = [(ids[a], ids[b]) for a, b in candidates]
    forward, backward = frame_distances(store, directed + [(j, i) for i, j in directed]).chunk(2)
    distance, order = torch.sort(((forward + backward) / 2).cpu(), stable=True)
    for n, far in zip(order.tolist(), distance.tolist(), strict=True):
        if far > max_distance or len(found) >= max_pairs:
            break
        if candidates[n] not in blocked:
            found.append(candidates[n])
            blocked.update(_neighbourhood(candidates[n], suppression))
    return [(ids[a], ids[b]) for a, b in found]


def _neighbourhood(pair: Pair, reach: int) -> list[Pair]:
    a, b = pair
    limit = max(min(abs(a - b) - 2, reach), 0)
    span = range(-limit, limit + 1)
    return [(a + x, b + y) for x in span for y in span if abs(x) + abs(y) <= limit]
