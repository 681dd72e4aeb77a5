"""A sparse symmetric system of 7 x 7 blocks that is solved repeatedly with different values."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

BLOCK = 7


@dataclass(frozen=True)
class BlockEquations:
    """Contributions to normal equations in blocks of one keyframe each; float64."""

    row: Int[Tensor, "b"]
    column: Int[Tensor, "b"]
    block: Float[Tensor, "b 7 7"]
    """Blocks added to the matrix at keyframes (row, column)."""
    gradient: Float[Tensor, "n 7"]
    """Right-hand side, the direction of descent."""

    def without_scale(self) -> "BlockEquations":
        """Return the same equations without the scales."""
        rigid = torch.ones(7, dtype=torch.float64)
        rigid[6] = 0
        block = self.block * rigid[:, None] * rigid
        return BlockEquations(self.row, self.column, block, self.gradient * rigid)


class BlockSystem:
    """Sparsity structure of the blocks, their elimination order, and the solver.

    The order keeps the factor sparse; it is computed once, on the graph of the blocks, which is
    much smaller than the system (minimum degree).
    """

    def __init__(self, row: Int[Tensor, "b"], column: Int[Tensor, "b"], count: int) -> None:
        """Blocks at ``row`` and ``column`` of ``count``, on both sides of the diagonal, possibly
        repeated; those outside the system, at -1, are left out."""
        from scipy.sparse import coo_matrix, csc_matrix

        self._given = row.clone(), column.clone()
        self._count = count
        self._inside = torch.nonzero((row >= 0) & (column >= 0))[:, 0]
        place = torch.from_numpy(_elimination_order(row, column, count))
        self._place = place
        # Every diagonal block exists, also for unconstrained keyframes.
        rows = torch.cat([place[row[self._inside]], torch.arange(count)])
        columns = torch.cat([place[column[self._inside]], torch.arange(count)])
        keys, at = torch.unique(columns * count + rows, return_inverse=True)
        self._at = at[: len(self._inside)]
        self._blocks = len(keys)
        self._diagonal_blocks = at[len(self._inside) :]
        within = np.arange(BLOCK)
        first, left = (BLOCK * k.numpy()[:, None, None] for k in (keys % count, keys // count))
        i, j = np.broadcast_arrays(first + within[:, None], left + within)
        size = BLOCK * count
        numbered = coo_matrix(
            (np.arange(i.size, dtype=np.float64), (i.ravel(), j.ravel())), shape=(size, size)
        ).tocsc()
        numbered.sort_indices()
        self._order = numbered.data.astype(np.int64)
        """Indices of the matrix's values, column by column, among those of all blocks."""
        self._matrix: csc_matrix = numbered

    def is_of(self, row: Int[Tensor, "b"], column: Int[Tensor, "b"]) -> bool:
        """Whether it was made for these blocks."""
        return torch.equal(row, self._given[0]) and torch.equal(column, self._given[1])

    def solve(
        self, block: Float[Tensor, "b 7 7"], gradient: Float[Tensor, "n 7"], damping: float
    ) -> Float[Tensor, "n 7"] | None:
        """Solve after raising the diagonal by a fraction of it; None if the system is singular.

        Unconstrained keyframes do not move.
        """
        from scipy.sparse.linalg import splu

        total = torch.zeros(self._blocks, BLOCK, BLOCK, dtype=torch.float64)
        total.index_add_(0, self._at, block[self._inside])
        diagonal = total[self._diagonal_blocks].diagonal(dim1=-2, dim2=-1)
        floor = 1e-12 * max(float(diagonal.max()) if diagonal.numel() else 0.0, 1e-300)
        total[self._diagonal_blocks] += torch.diag_embed(damping * diagonal + floor)
        self._matrix.data = total.numpy().reshape(-1)[self._order]
        right = torch.empty_like(gradient)
        right[self._place] = gradient
        try:
            # Symmetric and positive definite: pivots stay on the diagonal.
            factor = splu(
                self._matrix,
                permc_spec="NATURAL",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError:
            return None
        solution = factor.solve(right.reshape(-1).numpy())
        if not np.isfinite(solution).all():
            return None
        return torch.from_numpy(solution).reshape(self._count, BLOCK)[self._place]


def _elimination_order(
    row: Int[Tensor, "b"], column: Int[Tensor, "b"], count: int
) -> Int[np.ndarray, "n"]:
    """Return the position of each block row in a minimum-degree elimination order."""
    from scipy.sparse import coo_matrix, eye
    from scipy.sparse.linalg import splu

    both = ((row >= 0) & (column >= 0) & (row != column)).numpy()
    i, j = row.numpy()[both], column.numpy()[both]
    graph = coo_matrix((np.ones(len(i)), (i, j)), shape=(count, count)).tocsc()
    graph.data[:] = -1.0
    degree = np.asarray(abs(graph).sum(0)).ravel()
    graph = (graph + eye(count, format="csc").multiply(degree + 1)).tocsc()
    factor = splu(
        graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    return factor.perm_c.astype(np.int64)
