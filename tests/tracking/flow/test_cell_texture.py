"""What a match of a cell says along either axis."""

import numpy as np
import pytest

from geogs.tracking.flow.cell_texture import (
    SHARP,
    UNINFORMED,
    cell_structure,
    common_tensor,
    structure_of,
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
    parts = [p[OFFSET:-3:STRIDE, OFFSET:-3:STRIDE].reshape(-1) for p in common_tensor(image, image)]
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


def test_what_images_have_in_common_is_the_mean_product_of_their_gradients() -> None:
    """Against Sobel's operator and the mean written out, pixel by pixel."""
    rng = np.random.default_rng(2)
    images = rng.integers(0, 255, (2, 12, 14)).astype(np.uint8)
    window = 5
    padded = np.pad(images.astype(np.float64), [(0, 0), (1, 1), (1, 1)], mode="reflect")
    gradients = np.zeros((2, 2, 12, 14))
    smooth, change = np.array([1, 2, 1]), np.array([-1, 0, 1])
    for v in range(12):
        for u in range(14):
            around = padded[:, v : v + 3, u : u + 3]
            gradients[:, 0, v, u] = np.einsum("nab,a,b->n", around, smooth, change) / 8
            gradients[:, 1, v, u] = np.einsum("nab,a,b->n", around, change, smooth) / 8
    border = [(0, 0), (0, 0), (window // 2,) * 2, (window // 2,) * 2]
    gradients = np.pad(gradients, border, mode="reflect")
    found = common_tensor(images[0], images[1], window)
    for v in range(12):
        for u in range(14):
            a, b = gradients[:, :, v : v + window, u : u + window].reshape(2, 2, -1)
            products = a @ b.T / window**2
            expected = products[0, 0], products[1, 1], (products[0, 1] + products[1, 0]) / 2
            np.testing.assert_allclose([p[v, u] for p in found], expected, rtol=1e-5, atol=1e-3)


def test_noise_is_nothing_that_two_images_have_in_common() -> None:
    rng = np.random.default_rng(3)
    size, at = 256, (slice(OFFSET, -3, STRIDE),) * 2
    y, x = np.mgrid[:size, :size]
    bare = np.full((size, size), 128.0)
    waves = bare + 3 * np.sin(0.5 * x) + 3 * np.sin(0.5 * y)

    def certainty(scene: np.ndarray, noise: float, is_common: bool) -> float:
        """Mean of the cells, by one noisy image or by what two of them have in common."""
        one, two = (
            np.rint(scene + noise * rng.standard_normal(scene.shape)).astype(np.uint8)
            for _ in range(2)
        )
        tensor = common_tensor(one, two if is_common else one)
        return float(structure_of(*(p[at].reshape(-1) for p in tensor)).certainty.mean())

    clean = certainty(waves, 0.0, False)
    assert 0.4 < clean < 0.6
    assert certainty(bare, 3.0, False) > 0.7
    assert certainty(bare, 3.0, True) < 0.12
    assert certainty(waves, 3.0, False) > 0.95
    assert certainty(waves, 3.0, True) == pytest.approx(clean, abs=0.08)
