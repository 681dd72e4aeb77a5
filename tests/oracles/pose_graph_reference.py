"""The specification of a step of the Sim(3) pose graph: slow, dense, float64, by autograd."""

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.lie import retract, sim3_inverse, sim3_log
from geogs.loop import matched_edges
from geogs.loop.matched_edges import MatchedEdges
from geogs.loop.pose_graph import PoseGraph
from geogs.world.loops import RelativePoses


def relative_residuals(
    relative: RelativePoses, S: Float[Tensor, "n 4 4"], xi: Float[Tensor, "n 7"]
) -> Float[Tensor, "e 7"]:
    """log(G S_i S_j^-1) of every edge after the steps xi."""
    moved = retract(xi, S)
    rows = []
    for e in range(len(relative)):
        i, j = int(relative.source[e]), int(relative.target[e])
        rows.append(sim3_log(relative.G[e] @ moved[i] @ sim3_inverse(moved[j])))
    return torch.stack(rows)


def match_residuals(
    matches: MatchedEdges,
    S: Float[Tensor, "n 4 4"],
    xi: Float[Tensor, "n 7"],
    delta: Float[Tensor, "n p"],
) -> Float[Tensor, "e p 2"]:
    """Measured minus projected pixels after the steps xi of keyframes, delta of inverse depths."""
    moved, d = retract(xi, S), matches.inverse_depth.double() + delta
    rows = []
    for e in range(len(matches.source)):
        i, j = int(matches.source[e]), int(matches.target[e])
        S_ji = moved[j] @ sim3_inverse(moved[i])
        points = matches.rays.double() @ S_ji[:3, :3].mT + d[i][:, None] * S_ji[:3, 3]
        rows.append(matches.pixels[e].double() - matches.camera.project(points)[0])
    return torch.stack(rows)


def gauss_newton_step(
    graph: PoseGraph, damping: float
) -> tuple[Float[Tensor, "n 7"], Float[Tensor, "n p"]]:
    """The first step of a graph without loops, from the full normal equations.

    Damped as the fast solver is: inverse depths in the full system, keyframes relative to the
    diagonal of the system without depths. The matches' weights are Huber's at the given state.
    """
    assert graph.matches is not None
    m, S = graph.matches, graph.start
    n, p = m.inverse_depth.shape
    zero = torch.zeros(n, 7, dtype=torch.float64), torch.zeros(n, p, dtype=torch.float64)
    Je = torch.func.jacrev(lambda x: relative_residuals(graph.relative, S, x).reshape(-1))(zero[0])
    e, W = relative_residuals(graph.relative, S, zero[0]).reshape(-1), graph.relative.information
    Jx, Jd = torch.func.jacrev(lambda x, d: match_residuals(m, S, x, d).reshape(-1), (0, 1))(*zero)
    r = match_residuals(m, S, *zero)
    w = m.weight.double()
    norm = (w * r * r).sum(-1, keepdim=True).sqrt()
    huber = matched_edges.HUBER
    w = (matched_edges.FACTOR * w * (huber / norm.clamp(min=huber))).reshape(-1, 1)
    free = (~graph.fixed).repeat_interleave(7)
    seen = torch.zeros(n, dtype=torch.bool).index_fill_(0, m.source, True).repeat_interleave(p)
    Je, Jx, Jd = (
        Je.reshape(-1, 7 * n)[:, free],
        Jx.reshape(-1, 7 * n)[:, free],
        Jd.flatten(1)[:, seen],
    )
    r, W = r.reshape(-1), W.reshape(-1, 1)
    H = Je.mT @ (W * Je) + Jx.mT @ (w * Jx)
    E, C = Jx.mT @ (w * Jd), (Jd.mT @ (w * Jd)).diagonal()
    own = C.reshape(-1, p).mean(1).repeat_interleave(p)
    C = C * (1 + damping) + matched_edges.DEPTH_DAMPING * own
    C = torch.diag(C + 1e-12)
    reduced = H - E @ torch.linalg.inv(C) @ E.mT
    H = H + torch.diag(damping * reduced.diagonal())
    right = torch.cat([-Je.mT @ (W[:, 0] * e) - Jx.mT @ (w[:, 0] * r), -Jd.mT @ (w[:, 0] * r)])
    step = torch.linalg.solve(torch.cat([torch.cat([H, E], 1), torch.cat([E.mT, C], 1)]), right)
    k = int(free.sum())
    xi = zero[0].reshape(-1).masked_scatter(free, step[:k]).reshape(n, 7)
    return xi, zero[1].reshape(-1).masked_scatter(seen, step[k:]).reshape(n, p)
