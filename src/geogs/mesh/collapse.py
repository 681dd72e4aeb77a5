"""Edge collapse by quadric error, at many places at once."""

from copy import copy
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.gpu.kernels import kernels_for
from geogs.threads import run_chunks, worker_count

_SOURCE = Path(__file__).parent / "cuda" / "collapse.cu"
_THREADS = 128
_SPAN = 16384
"""Vertices or faces that a thread of the CPU takes at a time."""
_SHARE = 0.5
"""Part of the edges that may be collapsed next, the cheapest."""
_SAMPLES = 20_000
_MOST_ROUNDS = 300
_LEAST_PROGRESS = 0.002
"""Part of the faces that a round has to take away."""


class CollapsingMesh:
    """A mesh whose edges are collapsed, on the device where it lies; those at borders are not.

    In a round every edge is collapsed that is among the cheapest of the whole mesh and costs least
    of all near. Neither threads nor the device's order of work change what comes out.

    Method: quadric error (Garland and Heckbert 1997), each plane weighted by its face's area.
    """

    def __init__(self, vertices: Float[Tensor, "n 3"], faces: Int[Tensor, "m 3"]) -> None:
        """``vertices`` in map units; ``faces`` of int32. Neither is changed."""
        device, count = vertices.device, len(vertices)
        self.position = vertices.double()
        self.faces = faces.contiguous()
        self.parent = torch.arange(count, dtype=torch.int32, device=device)
        """A vertex that each was merged into, itself where it is left."""
        self._quadric = torch.empty((count, 10), dtype=torch.float64, device=device)
        self._cost = torch.empty((len(faces), 3), device=device)
        self._fixed = torch.empty(count, dtype=torch.bool, device=device)
        self._moved = torch.ones(count, dtype=torch.bool, device=device)
        self._rings = self._find_rings()
        mesh = (self.position, self.faces, *self._rings)
        self._over(count, "begin", *mesh, self._quadric, self._fixed)

    def reduced(self, count: int) -> "CollapsingMesh":
        """The mesh with at most so many faces, if there are so many edges to collapse."""
        new = copy(self)
        for name in ("position", "parent", "_quadric", "_cost", "_moved"):
            setattr(new, name, getattr(self, name).clone())
        for _ in range(_MOST_ROUNDS):
            before = len(new.faces)
            if before <= count:
                break
            new._round()
            if len(new.faces) > (1 - _LEAST_PROGRESS) * before:
                break
        return new

    def compact(self) -> tuple[Float[Tensor, "k 3"], Int[Tensor, "l 3"], Int[Tensor, "n"]]:
        """Vertices in float32 and faces that are left, and which vertex each of old became.

        That is -1 where it belongs to no face any more.
        """
        root = self.parent.long()
        while not torch.equal(further := root[root], root):
            root = further
        used = torch.zeros(len(root), dtype=torch.bool, device=root.device)
        used[self.faces.flatten().long()] = True
        number = torch.where(used, used.cumsum(0) - 1, -1)
        faces = number[self.faces.long()].to(torch.int32)
        return self.position[used].float(), faces, number[root]

    def _round(self) -> None:
        faces, count, size = self.faces, len(self.position), len(self.faces)
        self._over(
            size, "update_costs", self.position, faces, self._quadric, self._fixed, self._moved,
            self._cost,
        )  # fmt: skip
        self._moved.zero_()
        rank = torch.empty(3 * size, dtype=torch.int64, device=faces.device)
        best, around = (rank.new_empty(count) for _ in range(2))
        self._over(size, "rank_edges", self._cost, self._limit(), rank)
        self._over(count, "best_edges", *self._rings, rank, best)
        self._over(count, "best_around", faces, *self._rings, best, around)
        self._over(
            count, "collapse", faces, *self._rings, rank, best, around, self.position,
            self._quadric, self._cost, self.parent, self._moved,
        )  # fmt: skip
        self._squeeze()
        self._rings = self._find_rings()

    def _limit(self) -> Float[Tensor, "1"]:
        """The cost of the dearest edge that may be collapsed now."""
        costs = self._cost.flatten()
        some = costs[:: 1 + len(costs) // _SAMPLES].sort().values
        finite = torch.isfinite(some).sum()
        place = (finite * _SHARE).long().clamp(max=len(some) - 1)
        return some.index_select(0, place[None]).clamp(max=torch.finfo(torch.float32).max)

    def _squeeze(self) -> None:
        """Leave out faces of which two corners were merged."""
        if self.faces.device.type == "cpu":
            from geogs.mesh.collapse_kernels import squeeze

            faces, cost = torch.empty_like(self.faces), torch.empty_like(self._cost)
            arrays = (self.faces, self._cost, self.parent, faces, cost)
            left = squeeze(*(array.numpy() for array in arrays))
            self.faces, self._cost = faces[:left], cost[:left]
            return
        faces = self.parent[self.faces.long()]
        a, b, c = faces.unbind(1)
        left = ((a != b) & (b != c) & (c != a)).nonzero()[:, 0]
        self.faces, self._cost = faces[left], self._cost[left]

    def _find_rings(self) -> tuple[Tensor, Tensor]:
        """Where the corners at each vertex begin in the list of them, and that list.

        Corner 3 f + k is that of face f at its k-th vertex.
        """
        count = len(self.position)
        if self.faces.device.type == "cpu":
            from geogs.mesh.collapse_kernels import rings

            first, corners = rings(self.faces.numpy(), count)
            return torch.from_numpy(first), torch.from_numpy(corners)
        vertex, corners = self.faces.flatten().sort(stable=True)
        steps = torch.arange(count + 1, dtype=vertex.dtype, device=vertex.device)
        return torch.searchsorted(vertex, steps, out_int32=True), corners.to(torch.int32)

    def _over(self, count: int, name: str, *arrays: Tensor) -> None:
        """Run a kernel of the device for each of so many vertices or faces."""
        if self.faces.device.type == "cuda":
            kernel = kernels_for(_SOURCE, self.faces.device)[name]
            kernel(-(-count // _THREADS), _THREADS, count, *arrays)
            return
        from geogs.mesh import collapse_kernels

        loop, given = getattr(collapse_kernels, name), [array.numpy() for array in arrays]
        run_chunks(
            lambda n: loop(n * _SPAN, min((n + 1) * _SPAN, count), *given),
            -(-count // _SPAN),
            worker_count(),
        )
