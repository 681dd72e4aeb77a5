"""What a match of a cell says along either axis."""

import numpy as np
import pytest

from geogs.tracking.flow.cell_texture import (
    SHARP,
    UNINFORMED,
    cell_structure,
    structure_tensor,
)
from geogs.world.grid import OFFSET, STRIDE


def wave(across: tuple[float, float], size: int = 64) -> np.ndarray:
    """Stripes that change along one direction."""
    y, x = np.mgrid[:size, :size]
    return np.rint(128 + 60 * np.sin(0.8 * (across[0] * x + across[1] * y))).astype(np.uint8)


def inner(certainty: np.ndarray) -> np.ndarray:
    """Cells away from the border, which Sobel's and the mean's mirror."""
    side = round(len(certainty) ** 0.5)
    return certainty.reshape(side, side, 2)[1:-1, 1:-1].reshape(-1, 2)


@pytest.mark.parametrize(("across", "known"), [((1.0, 0.0), 0), ((0.0, 1.0), 1)])
def test_an_edge_counts_across_it_alone(across: tuple[float, float], known: int) -> None:
    certainty = inner(cell_structure(wave(across)).certainty)
    assert certainty[:, known].min() > 0.9
    assert certainty[:, 1 - known].max() < 0.03


def test_a_slanted_edge_counts_little_and_no_edge_next_to_nothing() -> None:
    certainty = inner(cell_structure(wave((0.7, 0.7))).certainty)
    assert certainty.min() > 0.01
    assert certainty.max() < 0.06
    np.testing.assert_allclose(
        cell_structure(np.full((64, 64), 90, np.uint8)).certainty, UNINFORMED
    )


def test_texture_counts_fully() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (64, 64), np.uint8)
    np.testing.assert_allclose(cell_structure(image).certainty, 1.0, rtol=1e-5)
    assert cell_structure(image).textured_fraction == 1.0


def test_it_is_what_one_coordinate_is_known_to_while_the_other_is_open() -> None:
    """Against eigenvectors and inverses, cell by cell."""
    rng = np.random.default_rng(1)
    coarse = rng.normal(0, 1, (64, 64)).cumsum(0)[:, ::-1].cumsum(1) / 12
    image = np.clip(100 + coarse + 6 * np.sin(np.arange(64) / 3), 0, 255).astype(np.uint8)
    parts = [p[OFFSET:-3:STRIDE, OFFSET:-3:STRIDE].reshape(-1) for p in structure_tensor(image)]
    expected = []
    for xx, yy, xy in zip(*parts, strict=True):
        values, vectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]], np.float64))
        information = np.minimum(1, values / SHARP + UNINFORMED)
        covariance = (vectors / information) @ vectors.T
        expected.append(1 / np.diag(covariance))
    found = cell_structure(image).certainty
    assert found.min() < 0.1
    assert found.max() > 0.5
    np.testing.assert_allclose(found, np.array(expected), rtol=1e-3)
