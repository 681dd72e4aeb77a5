"""The table of all poses against asking pose by pose."""

import numpy as np
import pytest
import torch

from geogs.geometry.lie import se3_exp, se3_inverse, so3_log
from geogs.world.arrays import PoseTable, rotation_angles


def random_table(count: int, seed: int = 0) -> PoseTable:
    random = torch.Generator().manual_seed(seed)
    table = PoseTable()
    for id in range(0, 2 * count, 2):  # every other keyframe was culled
        table[id] = se3_exp(torch.randn(6, generator=random, dtype=torch.float64))
    return table


def centre(table: PoseTable, id: int) -> np.ndarray:
    return se3_inverse(table[id])[:3, 3].numpy()


def test_rows_are_the_poses_also_after_they_were_replaced():
    table = random_table(100)
    table[8] = T = se3_exp(torch.full((6,), 0.3, dtype=torch.float64))
    assert table[8] is T
    for id, row, at in zip([8, 0, 198], table.rows([8, 0, 198]), table.centres([8, 0, 198]),
                           strict=True):  # fmt: skip
        np.testing.assert_array_equal(row, table[id].numpy())
        np.testing.assert_allclose(at, centre(table, id), atol=1e-12)


@pytest.mark.parametrize("count", [1, 7, 60, 100])
def test_the_nearest_are_those_of_a_search_one_by_one(count):
    table = random_table(60)
    ids = np.arange(0, 120, 2)
    away = {i: float(np.linalg.norm(centre(table, i) - centre(table, 34))) for i in ids.tolist()}
    expected = sorted(away, key=lambda i: away[i])[:count]
    assert table.nearest(34, ids, count).tolist() == expected


def test_of_equally_near_ones_the_first_are_taken():
    table = PoseTable()
    for id in range(9):
        table[id] = torch.eye(4, dtype=torch.float64)
    assert table.nearest(5, np.arange(9), 4).tolist() == [0, 1, 2, 3]


def test_those_around_are_near_and_look_the_same_way():
    table = random_table(80, seed=3)
    ids = np.arange(2, 160, 2)
    own, expected = table[0], []
    for id in ids.tolist():
        away = float(np.linalg.norm(centre(table, id) - centre(table, 0)))
        turn = float(torch.rad2deg(so3_log(own[:3, :3] @ table[id][:3, :3].mT).norm()))
        if away < 2.0 and turn < 90.0:
            expected.append((away, id))
    assert len(expected) > 5
    assert table.around(0, ids, 90.0, 2.0).tolist() == [id for _, id in sorted(expected)]


@pytest.mark.parametrize("degrees", [0.0, 1e-5, 30.0, 120.0, 179.9])
def test_turns_are_exact_at_small_and_large_angles(degrees):
    xi = torch.zeros(6, dtype=torch.float64)
    xi[4] = np.radians(degrees)
    T, other = torch.eye(4, dtype=torch.float64).numpy(), se3_exp(xi).numpy()
    assert rotation_angles(T, other[None])[0] == pytest.approx(degrees, abs=1e-9)
