"""Edge collapse by quadric error, of many edges at once."""

from copy import copy
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.gpu.kernels import kernels_for
from geogs.threads import run_chunks, worker_count

_SOURCE = Path(__file__).parent / "cuda" / "collapse.cu"
_THREADS = 128
_SPAN = 16384
"""Vertices or faces that a thread of the CPU takes at a time."""
_CHEAPEST = 0.8
"""Fraction of the edges, the cheapest, that may be collapsed next."""
_SAMPLES = 20_000
_MOST_ROUNDS = 300
_LEAST_PROGRESS = 0.0005
"""Least fraction of the faces that a round has to remove."""


class CollapsingMesh:
    """A mesh whose edges are collapsed, on the device where it lies; those at borders are not.

    In a round every edge is collapsed that is among the cheapest of the whole mesh and the cheapest
    at both of its ends, unless a cheaper such edge is near. The result depends neither on threads
    nor on the device's order of work.

    Method: quadric error (Garland and Heckbert 1997), each plane weighted by its face's area.
    """

    def __init__(self, vertices: Float[Tensor, "n 3"], faces: Int[Tensor, "m 3"]) -> None:
        """``vertices`` in map units; ``faces`` of int32. Neither is changed."""
        device = vertices.device
        count = len(vertices)
        self.became = torch.arange(count, device=device)
        """Current vertex of each original one, -1 if it has no face."""
        self.position = vertices.double()
        """Positions of the current vertices, float64."""
        self._corners = faces.flatten()
        self._parent = torch.arange(count, dtype=torch.int32, device=device)
        self._quadric = torch.empty((count, 10), dtype=torch.float64, device=device)
        self._fixed = torch.empty(count, dtype=torch.bool, device=device)
        self._cost = torch.empty(len(self._corners), device=device)
        self._bound = self.position.new_zeros(1)
        mesh = (self.position, self._corners, *self._rings())
        self._over(count, "begin", *mesh, self._quadric, self._fixed)

    @property
    def faces(self) -> Int[Tensor, "l 3"]:
        """Vertices of the current faces, int32."""
        return self._corners.view(-1, 3)

    def reduced(self, bound: float) -> "CollapsingMesh":
        """The mesh after nearly all edges up to a cost were collapsed, in map units.

        The cost of an edge is the root of a sum: the mean square, by area, of the merged vertex's
        distances to the planes of all its faces, and the square of a hundredth of the length.
        """
        new = copy(self)
        for name in ("position", "_corners", "_quadric", "_cost", "_parent"):
            setattr(new, name, getattr(self, name).clone())
        new._bound = self.position.new_tensor([bound])
        state = (new._quadric, new._fixed, new._bound, new._cost)
        new._over(len(new._corners), "edge_costs", new.position, new._corners, *state)
        for _ in range(_MOST_ROUNDS):
            before = len(new._corners)
            new._round()
            if len(new.faces) < len(new.position):  # half of the vertices are left
                new._renumber()
            if len(new._corners) > (1 - _LEAST_PROGRESS) * before:
                break
        new._renumber()
        return new

    def means(
        self, values: Float[Tensor, "n c"], known: Bool[Tensor, "n"]
    ) -> tuple[Float[Tensor, "k c"], Bool[Tensor, "k"]]:
        """Mean of the known values of the original vertices merged into each current one, and
        whether there are any."""
        known = known & (self.became >= 0)
        index = self.became[known]
        count = len(self.position)
        total = values.new_zeros(count, values.shape[1]).index_add_(0, index, values[known])
        number = torch.bincount(index, minlength=count)
        return total / number.clamp(min=1)[:, None], number > 0

    def _round(self) -> None:
        corners = self._corners
        count = len(self.position)
        rings = self._rings()
        best = torch.empty(count, dtype=torch.int64, device=corners.device)
        matched = torch.empty_like(best)
        self._over(count, "best_edges", *rings, self._cost, self._limit(), best)
        self._over(count, "match_vertices", corners, best, matched)
        self._over(
            count, "collapse", corners, *rings, matched, self._fixed, self._bound, self.position,
            self._quadric, self._cost, self._parent,
        )  # fmt: skip
        self._squeeze()

    def _limit(self) -> Float[Tensor, "1"]:
        """Highest cost of an edge that may be collapsed now."""
        some = self._cost[:: 1 + len(self._cost) // _SAMPLES].sort().values
        finite = torch.isfinite(some).sum()
        place = (finite * _CHEAPEST).long().clamp(max=len(some) - 1)
        return some.index_select(0, place[None]).clamp(max=torch.finfo(torch.float32).max)

    def _squeeze(self) -> None:
        """Remove faces of which two corners were merged."""
        corners = self._corners
        cost = self._cost
        if corners.device.type == "cpu":
            from geogs.mesh.decimation.decimation_kernels import squeeze

            left = torch.empty_like(corners), torch.empty_like(cost)
            count = squeeze(*(x.numpy() for x in (corners, cost, *left)))
            self._corners, self._cost = (x[:count] for x in left)
            return
        a, b, c = self.faces.unbind(1)
        kept = ((a != b) & (b != c) & (c != a)).nonzero()[:, 0]
        self._corners, self._cost = (x.view(-1, 3)[kept].flatten() for x in (corners, cost))

    def _renumber(self) -> None:
        """Remove vertices without a face."""
        root = self._parent.long()
        while not torch.equal(further := root[root], root):
            root = further
        used = torch.zeros(len(root), dtype=torch.bool, device=root.device)
        used[self._corners.long()] = True
        number = torch.where(used, used.cumsum(0) - 1, -1)
        now = number[root]
        self.became = torch.where(self.became >= 0, now[self.became], -1)
        self._corners = number[self._corners.long()].to(torch.int32)
        self.position = self.position[used]
        self._quadric = self._quadric[used]
        self._fixed = self._fixed[used]
        self._parent = torch.arange(len(self.position), dtype=torch.int32, device=root.device)

    def _rings(self) -> tuple[Tensor, Tensor]:
        """Index of each vertex's first corner in a list of corners by vertex, and that list.

        Corner 3 f + k is that of face f at its k-th vertex.
        """
        count = len(self.position)
        if self._corners.device.type == "cpu":
            from geogs.mesh.decimation.decimation_kernels import rings

            first, corners = rings(self._corners.numpy(), count)
            return torch.from_numpy(first), torch.from_numpy(corners)
        vertex, corners = self._corners.sort(stable=True)
        steps = torch.arange(count + 1, dtype=vertex.dtype, device=vertex.device)
        return torch.searchsorted(vertex, steps, out_int32=True), corners.to(torch.int32)

    def _over(self, count: int, name: str, *arrays: Tensor) -> None:
        """Run a kernel of the device for each of ``count`` vertices or faces."""
        if self._corners.device.type == "cuda":
            kernel = kernels_for(_SOURCE, self._corners.device)[name]
            kernel(-(-count // _THREADS), _THREADS, count, *arrays)
            return
        from geogs.mesh.decimation import decimation_kernels

        loop, given = getattr(decimation_kernels, name), [array.numpy() for array in arrays]
        run_chunks(
            lambda n: loop(n * _SPAN, min((n + 1) * _SPAN, count), *given),
            -(-count // _SPAN),
            worker_count(),
        )
