"""The rotation nearest to a matrix."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs.geometry.nearest_rotation import nearest_rotation


@pytest.mark.parametrize("mirrored", [False, True])
def test_no_other_rotation_is_nearer(mirrored: bool) -> None:
    random = np.random.default_rng(0)
    matrix = random.normal(size=(3, 3))
    if (np.linalg.det(matrix) < 0) is not mirrored:
        matrix = matrix[[1, 0, 2]]
    found = nearest_rotation(matrix)
    assert found @ found.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)
    others = Rotation.random(5000, random_state=1).as_matrix()
    assert np.trace(found.T @ matrix) > np.einsum("nij,ij->n", others, matrix).max()


def test_directions_are_turned_back() -> None:
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    first = np.random.default_rng(2).normal(size=(20, 3))
    assert nearest_rotation((first @ turn.T).T @ first) == pytest.approx(turn, abs=1e-12)
