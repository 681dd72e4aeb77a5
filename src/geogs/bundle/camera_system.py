"""The camera system: the equations of all poses once the depths are eliminated; float64.

The dense one has the shared unknowns of a problem, too. That of a large adjustment only has the
existing blocks: frames are in reverse Cuthill-McKee order, which gives a narrow band for a walk,
even with revisits, and the band is factored by Cholesky's method. At worst, when all frames see
each other, the band is the whole lower triangle.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.hyper_edge import HyperEdge
from geogs.bundle.problem import sources_within


class DenseCameraSystem:
    """Hessian and gradient over all poses, then shared unknowns."""

    def __init__(self, free_pose: Bool[Tensor, "n"], free_shared: Sequence[bool] = ()) -> None:
        self.frames = len(free_pose)
        free = [*free_pose.repeat_interleave(6).tolist(), *free_shared]
        self.free = torch.nonzero(torch.tensor(free))[:, 0]
        """Indices of the free rows."""
        self.hessian = torch.zeros(len(free), len(free), dtype=torch.float64)
        self.gradient = self.hessian.new_zeros(len(free))

    def add(self, edges: Iterable[HyperEdge]) -> None:
        """Add the equations of hyper-edges."""
        for edge in edges:
            rows = edge.rows(self.frames)
            hessian, gradient = edge.chained()
            self.hessian.index_put_((rows[:, None], rows), hessian, accumulate=True)
            self.gradient.index_add_(0, rows, gradient)

    def solve(self, damping: float, floor: float) -> Float[Tensor, "v"] | None:
        """Solve for steps of all unknowns, zero for fixed ones; None if not positive definite.

        The diagonal D is raised by ``damping`` |D| + ``floor``.
        """
        H = self.hessian
        g = self.gradient
        free = self.free
        step = torch.zeros_like(g)
        if not len(free):
            return step
        system = H[free[:, None], free]
        system = system + torch.diag(damping * system.diagonal().abs() + floor)
        factor, info = torch.linalg.cholesky_ex(system)
        if int(info):
            return None
        step[free] = torch.cholesky_solve(g[free, None], factor)[:, 0]
        return step if bool(torch.isfinite(step).all()) else None


@dataclass(frozen=True)
class PoseSums:
    """Summed equations of the poses from some sources, to be added to another system."""

    row: Int[Tensor, "m"]
    column: Int[Tensor, "m"]
    """Frames of each block; at most one block for two frames."""
    blocks: Float[Tensor, "m 6 6"]
    frame: Int[Tensor, "k"]
    gradient: Float[Tensor, "k 6"]


class SparseCameraSystem:
    """Blocks of the lower triangle over the free poses, and the right-hand side; all float64.

    Hyper-edges are added one by one, so that none has to be stored.
    """

    def __init__(
        self, source: Int[Tensor, "e"], target: Int[Tensor, "e"], free_pose: Bool[Tensor, "n"]
    ) -> None:
        self._free = free_pose
        self._count = n = int(free_pose.sum())
        self._slot = _ordered_slots(source, target, free_pose)
        keys = [np.arange(n) * (n + 1)]
        for frame, e in sources_within(source):
            at = self._slot[torch.cat([target[e], torch.tensor([frame])])]
            keys.append(np.unique(_lower(at, n)[0].numpy()))
        # Every diagonal block is listed, also of frames without edges.
        self._keys = torch.from_numpy(np.unique(np.concatenate(keys)))
        self.clear()

    def clear(self) -> None:
        """Set everything to zero."""
        self._blocks = torch.zeros(len(self._keys), 6, 6, dtype=torch.float64)
        self._gradient = torch.zeros(self._count, 6, dtype=torch.float64)

    @property
    def bandwidth(self) -> int:
        """Largest distance between the two frames of a block, in the order of the system."""
        if not self._count:
            return 0
        return int((self._keys // self._count - self._keys % self._count).max())

    @property
    def size(self) -> int:
        """Number of blocks."""
        return len(self._keys)

    def block_indices(
        self, row: Int[np.ndarray, "k"], column: Int[np.ndarray, "k"]
    ) -> Int[np.ndarray, "k"]:
        """Return the block of each pair of frames; -1 above the diagonal and for fixed poses."""
        slot = self._slot.numpy()
        i, j = slot[row], slot[column]
        found = np.searchsorted(self._keys.numpy(), i * self._count + j)
        return np.where((i >= j) & (j >= 0), found, -1)

    def add_sums(self, blocks: Float[Tensor, "m 6 6"], gradient: Float[Tensor, "n 6"]) -> None:
        """Add given sums to all blocks, and to the right-hand sides of all frames."""
        self._blocks += blocks
        free = self._free
        self._gradient.index_add_(0, self._slot[free], gradient[free])

    def add(self, edges: Iterable[HyperEdge]) -> None:
        """Add the equations of hyper-edges without shared unknowns."""
        for edge in edges:
            block, gradient = edge.pose_blocks()
            at = self._slot[edge.poses]
            keep = at >= 0
            self._gradient.index_add_(0, at[keep], gradient[keep])
            keys, rows, columns = _lower(at, self._count)
            place = torch.searchsorted(self._keys, keys)
            self._blocks.index_add_(0, place, block[rows, columns])

    def sums(self, numbers: Int[Tensor, "n"]) -> PoseSums:
        """Return all sums, with ``numbers`` as indices of the frames."""
        at = torch.empty(self._count, dtype=torch.long)
        at[self._slot[self._free]] = numbers[self._free]
        row, column = at[self._keys // self._count], at[self._keys % self._count]
        return PoseSums(row, column, self._blocks, at, self._gradient)

    def add_elsewhere_summed(self, sums: PoseSums) -> None:
        """Add the sums of a system of some of the sources."""
        i, j = self._slot[sums.row], self._slot[sums.column]
        known = (i >= 0) & (j >= 0)
        blocks = torch.where((i < j)[:, None, None], sums.blocks.mT, sums.blocks)[known]
        keys = (torch.maximum(i, j) * self._count + torch.minimum(i, j))[known]
        self._blocks.index_add_(0, torch.searchsorted(self._keys, keys), blocks)
        at = self._slot[sums.frame]
        self._gradient.index_add_(0, at[at >= 0], sums.gradient[at >= 0])

    def solve(self, damping: float, floor: float) -> Float[Tensor, "v"] | None:
        """Solve for steps of all poses, zero for fixed ones; None if not positive definite."""
        xi = torch.zeros(len(self._free), 6, dtype=torch.float64)
        if not self._count:
            return xi.reshape(-1)
        n = 6 * self._count
        width = 6 * (self.bandwidth + 1)
        band = np.zeros((width, n), order="F")
        within = np.arange(6)
        for begin in range(0, len(self._keys), 4096):
            keys = self._keys[begin : begin + 4096].numpy()
            row = 6 * (keys // self._count)[:, None, None] + within[:, None]
            column = 6 * (keys % self._count)[:, None, None] + within
            row, column = np.broadcast_arrays(row, column)
            lower = row >= column
            values = self._blocks[begin : begin + 4096].numpy()
            band[(row - column)[lower], column[lower]] = values[lower]
        band[0] += damping * np.abs(band[0]) + floor
        right = self._gradient.reshape(-1).numpy().copy()
        if not (np.isfinite(band).all() and np.isfinite(right).all()):
            return None
        from scipy.linalg import LinAlgError, solveh_banded

        try:
            solution = solveh_banded(
                band, right, overwrite_ab=True, overwrite_b=True, lower=True, check_finite=False
            )
        except LinAlgError:
            return None
        found = torch.from_numpy(solution).reshape(self._count, 6)
        xi[self._free] = found[self._slot[self._free]]
        return xi.reshape(-1) if np.isfinite(solution).all() else None


def _ordered_slots(
    source: Int[Tensor, "e"], target: Int[Tensor, "e"], free_pose: Bool[Tensor, "n"]
) -> Int[Tensor, "n"]:
    """Return the slot of each frame in the system, -1 where its pose is fixed."""
    n = int(free_pose.sum())
    slot = torch.full((len(free_pose),), -1, dtype=torch.long)
    slot[free_pose] = torch.arange(n)
    if not n:
        return slot
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    # Elimination joins edges that share a source: two steps in the graph of pairs.
    i, j = slot[source].numpy(), slot[target].numpy()
    both = (i >= 0) & (j >= 0)
    graph = coo_matrix((np.ones(int(both.sum())), (i[both], j[both])), shape=(n, n)).tocsr()
    graph = graph + graph.T
    order = reverse_cuthill_mckee((graph @ graph + graph).tocsr(), symmetric_mode=True)
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n)
    slot[free_pose] = torch.from_numpy(place)
    return slot


def _lower(
    at: Int[Tensor, "k"], count: int
) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"], Int[Tensor, "m"]]:
    """Return keys row * count + column of the blocks of some poses, and the poses of each."""
    wanted = (at[:, None] >= at[None]) & (at[None] >= 0)
    rows, columns = torch.nonzero(wanted, as_tuple=True)
    return at[rows] * count + at[columns], rows, columns
