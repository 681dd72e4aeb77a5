"""The DTU protocol on a generated scan: a table at z = 0 and planes at known heights above it."""

import numpy as np
import pytest
from scipy.io import savemat

from geogs.errors import InputError
from geogs.evaluation.surfaces.dtu_errors import (
    dense_points,
    evaluate_dtu,
    read_dtu_reference,
    thin,
)
from geogs.evaluation.surfaces.surface import Surface
from geogs.io.writers.ply_writer import write_mesh
from surface_shapes import joined, plane

HALF = 4.0
"""Half the side of the scanned square, mm."""


@pytest.fixture
def folder(tmp_path):
    """Scan 7: points 0.05 mm apart at z = 0 and, hidden below the table, at z = -30."""
    g = np.arange(-HALF, HALF + 1e-9, 0.05)
    x, y = (a.ravel() for a in np.meshgrid(g, g))
    points = np.concatenate([np.stack([x, y, np.full(x.size, z)], -1) for z in (0.0, -30.0)])
    write_mesh(tmp_path / "Points" / "stl" / "stl007_total.ply", points, np.zeros((0, 3), int))
    (tmp_path / "ObsMask").mkdir()
    observed = np.ones((6, 6, 6), np.uint8)
    observed[:3] = 0  # voxels of 2 mm around x = -5, -3, -1: below x = 0
    box = np.array([[-5.0, -5, -5], [5, 5, 5]])
    savemat(
        tmp_path / "ObsMask" / "ObsMask7_10.mat", {"ObsMask": observed, "BB": box, "Res": [[2.0]]}
    )
    savemat(tmp_path / "ObsMask" / "Plane7.mat", {"P": np.array([[0.0], [0], [1], [1]])})
    return tmp_path


def test_plane_half_a_millimetre_too_high(folder):
    reference = read_dtu_reference(folder, 7)
    assert reference.points.shape == (2 * 161**2, 3)
    errors = evaluate_dtu(plane(0.5, half=HALF, cells=3), reference)
    s = errors.scores
    assert s.d2s_mm == pytest.approx(0.5, abs=2e-3)
    # Up to 0.2 mm aside of a point of the mesh: between 0.5 and 0.54, in the mean about 0.507.
    assert 0.5 < s.s2d_mm < 0.515
    assert s.overall_mm == pytest.approx((s.d2s_mm + s.s2d_mm) / 2)
    assert (s.d2s_left_out, s.s2d_left_out) == (0.0, 0.0)
    assert s.scan_points == 161**2  # those at z = -30 are below the plane
    assert errors.reconstruction_points[:, 0].min() > 0  # the scanner did not see the rest


def test_a_missing_half_counts_up_to_two_centimetres(folder):
    reference = read_dtu_reference(folder, 7)
    right = plane(0.0, half=HALF, cells=2)
    right = right.part((right.vertices[right.faces][..., 0] >= 0).all(1))
    s = evaluate_dtu(right, reference).scores
    # Half lies between points 0.2 mm apart, about 0.1 mm from them; half is 0 to 4 mm farther.
    assert s.s2d_mm == pytest.approx((0.1 + 2.1) / 2, abs=0.03)
    high = plane(25.0, half=HALF, cells=2)
    both = evaluate_dtu(joined(right, high), reference).scores
    assert both.s2d_mm == pytest.approx(
        s.s2d_mm, abs=0.02
    )  # 25 mm above the scan, outside the observed voxels
    assert both.d2s_mm == pytest.approx(s.d2s_mm, abs=1e-3)
    with pytest.raises(InputError, match="where the DTU scanner could see"):
        evaluate_dtu(high, reference)


def test_far_points_are_left_out(folder):
    reference = read_dtu_reference(folder, 7)
    tall = type(reference)(
        reference.points, np.ones((60, 60, 60), bool), reference.low, reference.low + 60, 1.0,
        reference.plane,
    )  # fmt: skip
    high = plane(22.0, half=HALF, cells=2)
    s = evaluate_dtu(joined(plane(0.1, half=HALF, cells=2), high), tall).scores
    assert s.d2s_mm == pytest.approx(0.1, abs=0.01)
    assert s.d2s_left_out == pytest.approx(50, abs=3)
    with pytest.raises(InputError, match="nowhere nearer than 20 mm"):
        evaluate_dtu(high, tall)


def test_same_seed_same_scores(folder):
    reference = read_dtu_reference(folder, 7)
    moved = plane(0.5, half=HALF, cells=3)
    a, b = (evaluate_dtu(moved, reference, seed=3).scores for _ in "ab")
    assert a == b


def test_missing_and_wrong_files_are_input_errors(folder):
    with pytest.raises(InputError, match=r"ObsMask8_10\.mat does not exist"):
        read_dtu_reference(folder, 8)
    (folder / "ObsMask" / "ObsMask7_10.mat").write_bytes(b"no matrix")
    with pytest.raises(InputError, match="damaged or no MATLAB file"):
        read_dtu_reference(folder, 7)
    savemat(folder / "ObsMask" / "ObsMask7_10.mat", {"ObsMask": np.ones((2, 2, 2))})
    with pytest.raises(InputError, match="lacks"):
        read_dtu_reference(folder, 7)


def greedy(points: np.ndarray, radius: float) -> np.ndarray:
    """Thinning as one would say it: all pairs."""
    near = ((points[:, None] - points) ** 2).sum(-1) <= radius**2
    kept = np.ones(len(points), bool)
    for i in range(len(points)):
        if kept[i]:
            kept[near[i]] = False
            kept[i] = True
    return kept


@pytest.mark.parametrize("radius", [0.01, 0.2, 0.9, 5.0])
def test_thinning_is_the_greedy_one(radius):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(1500, 3)) * [1, 1, 0.1] + [1000.0, -500, 3]
    points = np.concatenate([points, points[:20]])  # some twice
    kept = thin(points, radius)
    assert np.array_equal(kept, greedy(points - points.mean(0), radius))
    assert kept[0]
    assert not kept[-20:].any()
    assert len(thin(np.zeros((0, 3)), 1.0)) == 0


def test_dense_points_of_a_right_triangle():
    """Legs of 1 and 2: 5 by 10 cells of a fifth, those with their centre inside stay."""
    triangle = Surface(np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]]), np.array([[0, 1, 2]]))
    # The spacing is 0.19 sqrt(1 * 2 / 2), which makes floor(1 / 0.19) = 5 and floor(2 / 0.19) = 10.
    points = dense_points(triangle, 0.19)
    assert np.array_equal(points[:3], triangle.vertices)
    grid = [((i + 0.5) / 5, (j + 0.5) / 5) for i in range(5) for j in range(10)]
    expected = [(x, y, 0) for x, y in grid if x + y / 2 < 1 - 1e-12]
    assert np.allclose(points[3:], expected)
    flat = Surface(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]))
    assert len(dense_points(flat, 0.1)) == 3
