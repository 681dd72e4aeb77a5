"""The sparse solver of blocks against the dense system."""

import pytest
import torch

from geogs.loop.block_system import BLOCK, BlockSystem

F64 = torch.float64


def random_system(count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rows, columns and blocks of edges between random rows, one side of some outside."""
    random = torch.Generator().manual_seed(count)
    i, j = torch.randint(-1, count, (2, 4 * count), generator=random)
    i, j = i[i != j], j[i != j]
    J = torch.randn(len(i), 2, BLOCK, BLOCK, dtype=F64, generator=random)
    own, other, cross = J[:, 0].mT @ J[:, 0], J[:, 1].mT @ J[:, 1], J[:, 0].mT @ J[:, 1]
    blocks = torch.cat([own, other, cross, cross.mT])
    return torch.cat([i, j, i, j]), torch.cat([i, j, j, i]), blocks


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
@pytest.mark.parametrize("count", [1, 2, 30])
def test_it_solves_what_the_dense_system_does(count, damping):
    row, column, blocks = random_system(count)
    gradient = torch.randn(count, BLOCK, dtype=F64, generator=torch.Generator().manual_seed(1))
    H = torch.zeros(count, BLOCK, count, BLOCK, dtype=F64)
    for r, c, block in zip(row.tolist(), column.tolist(), blocks, strict=True):
        if r >= 0 and c >= 0:
            H[r, :, c] += block
    H = H.reshape(BLOCK * count, BLOCK * count)
    diagonal = H.diagonal().clone()
    H += torch.diag(damping * diagonal + 1e-12 * max(float(diagonal.max()), 1e-300))
    expected = torch.linalg.solve(H, gradient.reshape(-1)).reshape(count, BLOCK)
    system = BlockSystem(row, column, count)
    for factor in (1.0, 2.0):  # made once, solved with other numbers
        found = system.solve(factor * blocks, factor * gradient, damping)
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9)
    assert system.is_of(row, column)
    assert not system.is_of(column, row)


def test_what_nothing_ties_down_stays():
    row, column, blocks = random_system(6)
    far = (
        torch.where(row >= 0, row + (row >= 3), row),
        torch.where(column >= 0, column + (column >= 3), column),
    )
    gradient = torch.ones(7, BLOCK, dtype=F64)
    gradient[3] = 0
    found = BlockSystem(*far, 7).solve(blocks, gradient, 0.0)
    assert found is not None
    assert float(found[3].abs().max()) == 0.0
