"""Flow from the first of some keyframes to each of the others, chained step by step."""

from itertools import pairwise

from jaxtyping import Float
from torch import Tensor

from geogs.tracking.flow.filled import filled_positions
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.matching.sparse_features import guided_flows
from geogs.types import FlowMatch
from geogs.world.edges import Pair

Positions = tuple[Float[Tensor, "p 2"], Float[Tensor, "p 2"]]
"""Positions of the cells of one keyframe in another, and of the other's cells in it."""


class ChainedFlows:
    """Flows between the keyframes of a graph that has no map yet.

    Repeated attempts to start share most keyframes with the last one; their flows are kept.
    """

    def __init__(self, graph: FrameGraph) -> None:
        self.graph = graph
        self._steps: dict[Pair, Positions] = {}
        self._ids: list[int] = []
        """Keyframes of the last attempt."""
        self._flows: list[FlowMatch] = []
        self._reached: list[Positions] = []
        """Positions with unmatched cells filled in, from which the chain continues."""

    def measure(self) -> list[FlowMatch]:
        """Measure one edge from the first keyframe to each later one."""
        ids = self.graph.keyframes.ids
        self._measure_steps(ids)
        same = next(
            (n for n, (a, b) in enumerate(zip(ids, self._ids, strict=False)) if a != b),
            min(len(ids), len(self._ids)),
        )
        kept = max(same - 1, 0)
        self._ids, self._flows, self._reached = ids, self._flows[:kept], self._reached[:kept]
        for k in range(kept + 1, len(ids)):
            self._reach(ids, k)
        return list(self._flows)

    def forget(self) -> None:
        """Free all flows, once there is a map."""
        self._steps, self._ids, self._flows, self._reached = {}, [], [], []

    def _reach(self, ids: list[int], k: int) -> None:
        """Measure the flow to the k-th keyframe from that to the one before it."""
        grid, operator = self.graph.keyframes.grid, self.graph.operator
        step, back_step = self._steps[ids[k - 1], ids[k]]
        there, back = step, back_step
        if k > 1:
            reached, returned = self._reached[k - 2]
            there = reached + grid.sample_field(step - grid.pixels, reached)
            back = back_step + grid.sample_field(returned - grid.pixels, back_step)
        first, last = (self.graph.keyframes[ids[n]].encoded for n in (0, k))
        match, reverse = operator.measure([first], [last], there[None], back[None], fine=True)
        self._flows.append(match)
        self._reached.append((filled_positions(grid, match), filled_positions(grid, reverse)))

    def _measure_steps(self, ids: list[int]) -> None:
        """Measure the flow between consecutive keyframes, in both directions."""
        keyframes, operator = self.graph.keyframes, self.graph.operator
        pairs = list(pairwise(ids))
        self._steps = {p: self._steps[p] for p in pairs if p in self._steps}
        new = [p for p in pairs if p not in self._steps]
        if not new:
            return
        first, second = ([keyframes[p[k]].encoded for p in new] for k in (0, 1))
        flows = guided_flows(keyframes.grid, operator, first, second)
        for pair, (there, back) in zip(new, flows, strict=True):
            self._steps[pair] = there.pixels[0], back.pixels[0]
