"""Scores of an object inside its masks; exact distances to triangles."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from geogs.errors import InputError
from geogs.evaluation.surfaces.object_errors import evaluate_object
from geogs.evaluation.surfaces.silhouettes import (
    Silhouette,
    cull_by_masks,
    dilate,
    inside_masks,
    mesh_silhouettes,
)
from geogs.evaluation.surfaces.surface import Surface, read_surface
from geogs.evaluation.surfaces.surface_distance import TriangleTree, closest_point_on_triangle
from geogs.geometry.camera import Camera
from surface_shapes import CAMERA, NO_FACES, joined, moved, plane

HORSE = Path(__file__).parents[3] / "shared" / "data" / "objects" / "horse"


def all_pairs(points: np.ndarray, mesh: Surface) -> np.ndarray:
    """Distance to the nearest of all triangles."""
    corners = mesh.vertices[mesh.faces]
    return np.array([
        np.linalg.norm(
            closest_point_on_triangle(np.tile(p, (len(corners), 1)), *corners.transpose(1, 0, 2))
            - p, axis=1,
        ).min()
        for p in points
    ])  # fmt: skip


@pytest.mark.parametrize("count", [1, 3, 4, 5, 300])
def test_tree_finds_the_nearest_of_all_triangles(count):
    rng = np.random.default_rng(count)
    centre = rng.normal(size=(count, 1, 3))
    size = 10.0 ** rng.uniform(-3, 0.5, (count, 1, 1))  # tiny and huge ones together
    corners = centre + size * rng.normal(size=(count, 3, 3))
    corners[0, 2] = corners[0, 1]  # a line
    mesh = Surface(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))
    points = rng.normal(size=(400, 3)) * 1.5
    points[200:] = points[200] + np.cumsum(rng.normal(size=(200, 3)) * 1e-3, 0)  # in order
    expected = all_pairs(points, mesh)
    tree = TriangleTree(mesh)
    distance, face = tree.nearest(points)
    assert np.abs(distance - expected).max() < 1e-12
    at = closest_point_on_triangle(points, *corners[face].transpose(1, 0, 2))
    assert np.abs(np.linalg.norm(at - points, axis=1) - expected).max() < 1e-12
    limited = tree(points, 0.3)
    assert np.array_equal(np.isinf(limited), expected > 0.3)
    near = expected <= 0.3
    assert np.abs(limited[near] - expected[near]).max(initial=0) < 1e-12
    with pytest.raises(InputError, match="no triangles"):
        TriangleTree(Surface(points, NO_FACES))


def test_masks_decide_by_every_view_that_has_the_point_in_its_image():
    mask = np.zeros((120, 160), bool)
    mask[50:70, 70:90] = True
    front = Silhouette(mask, CAMERA, np.eye(4))
    points = np.array([
        [0.0, 0, 1],  # on the mask
        [0.0, 0, -1],  # behind the camera: not judged
        [9.0, 0, 1],  # outside the image: not judged
        [0.3, 0, 1],  # beside the mask
        [0.10, 0, 1],  # column 89.5, which rounds up to 90: just beside
        [0.0999, 0, 1],
    ])  # fmt: skip
    assert inside_masks(points, [front]).tolist() == [True, True, True, False, False, True]
    empty = Silhouette(np.zeros_like(mask), CAMERA, np.eye(4))
    assert inside_masks(points, [front, empty]).tolist() == [False, True, True] + [False] * 3
    wide = replace(front, mask=dilate(mask, 21.0))
    assert inside_masks(points, [wide])[3]  # 20 pixels beside the last column
    assert np.count_nonzero(front.dilated().mask) == np.count_nonzero(dilate(mask, 2.4))


def test_dilation_is_by_a_disk():
    mask = np.zeros((41, 41), bool)
    mask[20, 20] = True
    y, x = np.mgrid[-20:21, -20:21]
    assert np.array_equal(dilate(mask, 7.0), x**2 + y**2 <= 49)
    assert not dilate(np.zeros((5, 5), bool), 3.0).any()


def test_mesh_is_cut_to_triangles_inside_the_masks():
    view = mesh_silhouettes(plane(1.0, half=0.19), CAMERA, np.eye(4)[None])
    assert view[0].mask.sum() == 38 * 38
    cut = cull_by_masks(plane(1.0, half=0.5, cells=10), view)
    assert np.abs(cut.vertices[:, :2]).max() == pytest.approx(0.1)
    widened = [replace(view[0], mask=dilate(view[0].mask, 12.0))]
    assert np.abs(
        cull_by_masks(plane(1.0, half=0.5, cells=10), widened).vertices[:, :2]
    ).max() == pytest.approx(0.3)


def test_shifted_plane_and_clutter():
    """Result 0.6 mm too far on the left, 1.5 mm on the right; clutter outside and 4 cm behind."""
    truth = plane(1.0, half=0.3, cells=2)
    half = truth.part((truth.vertices[truth.faces][..., 0] <= 0).all(1))
    left = moved(half, 0, 0, 0.0006)
    right = Surface(half.vertices * [-1, 1, 1] + [0, 0, 0.0015], half.faces)
    behind = moved(half, 0, 0, 0.04)
    beside = moved(half, 0.75, 0, 0)
    view = mesh_silhouettes(truth, CAMERA, np.eye(4)[None])
    result = joined(left, right, behind, beside)
    wide = replace(view[0], mask=dilate(view[0].mask, 1.0))
    s = evaluate_object(result, truth, [wide], samples=40_000).scores
    assert s.outside_masks == pytest.approx(25, abs=2)
    assert s.accuracy_left_out == pytest.approx(100 / 3, abs=1)
    assert s.accuracy_mm == pytest.approx(1.05, abs=0.01)
    assert s.accuracy_median_mm == pytest.approx(0.6, abs=0.91)
    assert s.precision == pytest.approx(50, abs=1)
    assert s.recall == pytest.approx(50, abs=1)
    assert s.f_score == pytest.approx(50, abs=1)
    assert s.completeness_mm == pytest.approx(1.05, abs=0.01)
    assert s.chamfer_mm == pytest.approx((s.accuracy_mm + s.completeness_mm) / 2)


def test_a_hole_costs_completeness_and_far_truth_is_counted_as_left_out():
    truth = plane(1.0, half=0.3, cells=2)
    half = truth.part((truth.vertices[truth.faces][..., 0] <= 0).all(1))
    view = mesh_silhouettes(truth, CAMERA, np.eye(4)[None])
    s = evaluate_object(half, truth, view, samples=20_000).scores
    assert s.accuracy_mm < 1e-6
    assert s.precision == 100.0
    # x in [0, 0.3] is x away; 0.02 of it counts, 0.28 is left out.
    assert s.completeness_left_out == pytest.approx(100 * 0.28 / 0.6, abs=0.5)
    assert s.completeness_mm == pytest.approx(10 * 0.02 / 0.32, abs=0.05)
    with pytest.raises(InputError, match="frame of the true poses"):
        evaluate_object(plane(1.5), truth, view, samples=1000)


@pytest.mark.skipif(not HORSE.is_dir(), reason="the horse is not here")
def test_horse_against_itself_and_a_shifted_copy():
    truth = read_surface(HORSE / "mesh_object.ply")
    seen = read_surface(HORSE / "points_seen_1mm.ply")
    poses = np.loadtxt(HORSE / "traj.txt").reshape(-1, 4, 4)
    camera = Camera(725.0, 725.0, 199.625, 149.625, 400, 300)
    views = [s.dilated() for s in mesh_silhouettes(truth, camera, np.linalg.inv(poses[::8]))]
    seen = Surface(seen.vertices[::20], NO_FACES)
    begin = time.perf_counter()
    itself = evaluate_object(truth, truth, views, seen, samples=200_000).scores
    print(f"{time.perf_counter() - begin:.2f} s")
    assert itself.accuracy_mm < 1e-6
    assert itself.completeness_mm < 0.005  # a few seen points are of the floor at its feet
    assert itself.f_score == 100.0
    assert itself.outside_masks == 0.0
    high = moved(truth, 0, 0, 0.002)
    shifted = evaluate_object(high, truth, views, seen, samples=200_000).scores
    assert 0.4 < shifted.accuracy_mm < 2.0  # less where the surface stands upright
    assert shifted.f_score < 90
