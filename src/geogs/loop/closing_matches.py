"""The dense matches that close loops: of the frame graph, and of the loops themselves."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.loop.matched_edges import MatchedEdges
from geogs.tracking.graph.dynamic_cells import static_weight
from geogs.world.edges import Edge, Pair, edge_matches
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet
from geogs.world.loops import Loop


def closing_matches(
    segment: KeyframeSet, edges: Mapping[Pair, Edge], loops: Sequence[Loop]
) -> MatchedEdges | None:
    """Matches between places in the segment's order, on the CPU; none where there are none.

    Both directions of the frame graph's edges and of the loops within the segment; where a pair is
    in both, the frame graph's.
    """
    found: dict[Pair, tuple[Tensor, Tensor]] = {}
    for loop in loops:
        if loop.first in segment and loop.second in segment:
            for pair, flow in (
                ((loop.first, loop.second), loop.flows[0]),
                ((loop.second, loop.first), loop.flows[1]),
            ):
                found[pair] = flow.pixels[0], flow.weight[0]
    for pair, edge in edges.items():
        (pixels,), (weight,) = edge_matches(segment.grid, [edge])
        found[pair] = pixels, weight
    if not found:
        return None
    pairs, ids = sorted(found), segment.ids
    place = {k: n for n, k in enumerate(ids)}
    pixels, weight = (torch.stack([found[p][k] for p in pairs]) for k in (0, 1))
    grid = SampleGrid(segment.grid.camera) if segment.grid.on_gpu else segment.grid
    return MatchedEdges(
        grid.camera,
        grid.rays,
        segment.inverse_depths(ids).cpu(),
        torch.tensor([place[i] for i, _ in pairs]),
        torch.tensor([place[j] for _, j in pairs]),
        pixels.cpu().float(),
        static_weight(segment, pairs, pixels, weight).cpu().float(),
    )


def take_over_depths(
    segment: KeyframeSet,
    edges: Mapping[Pair, Edge],
    inverse_depth: Mapping[int, Float[Tensor, "p"]],
) -> None:
    """Give keyframes the inverse depth that a closing has found, before its scales are applied.

    Only those of the frame graph: what is left of the matches of others is a loop's, which alone
    says less of a depth than all those that have made it.
    """
    sources = {i for i, _ in edges}
    for id, own in inverse_depth.items():
        if id in sources:
            keyframe = segment[id]
            keyframe.inverse_depth = own.to(keyframe.inverse_depth)
