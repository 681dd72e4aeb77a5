"""Rotation averaging: orientations of frames from relative rotations between them."""

from collections import defaultdict, deque
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from geogs.geometry.lie import so3_exp, so3_log
from geogs.world.frames import RelativeRotation

ROUNDS = 3
"""Gauss-Newton steps of the averaging."""


def orientations(
    relative: Mapping[int, Sequence[RelativeRotation]], known: Mapping[int, Float64[Tensor, "3 3"]]
) -> dict[int, Float64[Tensor, "3 3"]]:
    """Estimate world to camera of all frames linked to the known ones by relative rotations.

    Contradictions between several paths to a frame are distributed by least squares, weighted by
    the deviations. If nothing is known, the earliest frame of the largest linked group is the
    world. Known frames are left out.

    Args:
        relative: rotations relative to earlier frames, by the index of each frame.
        known: rotations of fixed frames, by index.
    """
    links = [(t.frame, n, t.R, t.deviation) for n, several in relative.items() for t in several]
    neighbours: dict[int, list[tuple[int, Tensor]]] = defaultdict(list)
    for a, b, R, _ in links:
        neighbours[a].append((b, R))
        neighbours[b].append((a, R.mT))
    fixed = dict(known) or _earliest_of_largest(neighbours)
    found = _followed(neighbours, fixed)
    free = sorted(found.keys() - fixed.keys())
    moved = set(free)
    used = [link for link in links if link[0] in found and not moved.isdisjoint(link[:2])]
    for _ in range(ROUNDS if free else 0):
        steps = _steps(free, used, found)
        found |= {n: step @ found[n] for n, step in zip(free, steps, strict=True)}
    return {n: R for n, R in found.items() if n not in known}


def _earliest_of_largest(neighbours: Mapping[int, list[tuple[int, Tensor]]]) -> dict[int, Tensor]:
    """Return the identity for the earliest frame of the largest group; empty without links."""
    best: list[int] = []
    left = set(neighbours)
    while left:
        group = sorted(_followed(neighbours, {min(left): torch.eye(3, dtype=torch.float64)}))
        best = max(best, group, key=len)
        left -= set(group)
    return {best[0]: torch.eye(3, dtype=torch.float64)} if best else {}


def _followed(
    neighbours: Mapping[int, list[tuple[int, Tensor]]], start: Mapping[int, Tensor]
) -> dict[int, Tensor]:
    """Return the rotations of the start and of all frames linked to it, by the fewest links."""
    found = dict(start)
    queue = deque(start)
    while queue:
        a = queue.popleft()
        for b, R in neighbours.get(a, ()):
            if b not in found:
                found[b] = R @ found[a]
                queue.append(b)
    return found


def _steps(
    free: list[int], links: list[tuple[int, int, Tensor, float]], found: dict[int, Tensor]
) -> Float64[Tensor, "n 3 3"]:
    """Return a Gauss-Newton step of each free rotation, from the left.

    With ``R_b R_a^T`` for the rotation R of b relative to a, the error is
    ``log(R (R_b R_a^T)^T)``; to first order it falls by ``phi_b - (R_b R_a^T) phi_a``.
    """
    from scipy.sparse import coo_matrix  # slow to import
    from scipy.sparse.linalg import spsolve

    column = {n: 3 * k for k, n in enumerate(free)}
    first = torch.stack([found[a] for a, _, _, _ in links])
    second = torch.stack([found[b] for _, b, _, _ in links])
    measured = torch.stack([link[2] for link in links])
    precision = 1 / torch.tensor([link[3] for link in links], dtype=torch.float64)
    relative = second @ first.mT
    error = precision[:, None] * so3_log(measured @ relative.mT)
    blocks = torch.stack([torch.eye(3).to(relative).expand_as(relative), -relative], 1)
    values = (precision[:, None, None, None] * blocks).numpy()
    ends = np.array([[column.get(b, -1), column.get(a, -1)] for a, b, _, _ in links])
    link, end = np.nonzero(ends >= 0)
    rows, columns = np.broadcast_arrays(
        3 * link[:, None, None] + np.arange(3)[:, None], ends[link, end, None, None] + np.arange(3)
    )
    at = rows.ravel(), columns.ravel()
    shape = (3 * len(links), 3 * len(free))
    J = coo_matrix((values[link, end].ravel(), at), shape).tocsc()
    step = spsolve((J.T @ J).tocsc(), J.T @ error.numpy().ravel())
    return so3_exp(torch.from_numpy(step).reshape(-1, 3))
