"""Surface scores of shapes whose distances are known; culling; ICP; PLY reading."""

import numpy as np
import pytest
import torch

from geogs.errors import InputError
from geogs.evaluation.surfaces.icp import icp
from geogs.evaluation.surfaces.raster import render_mesh
from geogs.evaluation.surfaces.reconstruction_errors import evaluate_reconstruction
from geogs.evaluation.surfaces.surface import Surface, read_surface, sample_surface
from geogs.evaluation.surfaces.surface_distance import SurfaceDistance, closest_point_on_triangle
from geogs.evaluation.surfaces.visibility import Visibility
from geogs.geometry.lie import se3_exp
from geogs.io.writers.ply_writer import write_mesh
from surface_shapes import CAMERA, NO_FACES, joined, plane


@pytest.mark.parametrize("cells", [1, 37])
def test_shifted_plane_is_exact_whatever_its_tessellation(cells):
    errors = evaluate_reconstruction(plane(1.012, cells=cells), plane(1.0), samples=5000)
    s = errors.scores
    assert s.accuracy_cm == pytest.approx(1.2, abs=1e-3)
    assert s.completeness_cm == pytest.approx(1.2, abs=1e-3)
    assert s.chamfer_cm == pytest.approx(1.2, abs=1e-3)
    assert (s.completeness_ratio, s.precision_ratio, s.f_score) == (100.0, 100.0, 100.0)
    far = evaluate_reconstruction(plane(1.06), plane(1.0), samples=1000).scores
    assert (far.completeness_ratio, far.precision_ratio, far.f_score) == (0.0, 0.0, 0.0)


def test_a_missing_half_costs_completeness_only():
    """Truth 2 x 2 m, reconstruction its half x < 0: a quarter... x in [0, 1] lies x away."""
    whole = plane(1.0, cells=2)
    left = Surface(whole.vertices, whole.faces[(whole.vertices[whole.faces][..., 0] <= 0).all(1)])
    s = evaluate_reconstruction(left, whole, samples=40000).scores
    assert s.accuracy_cm == pytest.approx(0, abs=1e-3)
    assert s.completeness_cm == pytest.approx(25.0, abs=0.1)  # half of the mean of x in [0, 1]
    assert s.completeness_ratio == pytest.approx(52.5, abs=0.2)
    assert s.precision_ratio == 100.0
    assert s.f_score == pytest.approx(2 * 52.5 / 1.525, abs=0.3)


def test_seen_points_take_over_completeness():
    whole = plane(1.0, cells=2)
    left = Surface(whole.vertices, whole.faces[(whole.vertices[whole.faces][..., 0] <= 0).all(1)])
    points = np.random.default_rng(0).uniform([-1, -1, 1], [0, 1, 1], (3000, 3))
    s = evaluate_reconstruction(left, whole, Surface(points, NO_FACES), samples=5000).scores
    assert s.completeness_cm == pytest.approx(0, abs=1e-3)
    assert s.completeness_samples == 3000


def test_same_seed_same_scores():
    a, b = (evaluate_reconstruction(plane(1.01), plane(1.0), samples=999, seed=5) for _ in "ab")
    assert a.scores == b.scores
    assert np.array_equal(a.reconstruction_points, b.reconstruction_points)


def test_samples_are_uniform_by_area():
    small, large = plane(0.0, half=0.5, cells=9), plane(1.0, half=1.5, cells=1)
    points, face = sample_surface(joined(small, large), 20000, np.random.default_rng(0))
    assert (points[:, 2] == 0).mean() == pytest.approx(0.1, abs=0.001)  # 1 of 10 square metres
    on_large = points[points[:, 2] == 1]
    counts = np.histogram2d(on_large[:, 0], on_large[:, 1], bins=3)[0] / len(on_large)
    assert np.abs(counts - 1 / 9).max() < 0.01
    assert face.max() < len(small.faces) + len(large.faces)


def test_closest_point_matches_a_dense_search():
    rng = np.random.default_rng(0)
    p, a, b, c = rng.normal(size=(4, 60, 3))
    c[0] = b[0] = a[0]  # a point
    c[1] = a[1] + 0.4 * (b[1] - a[1])  # a line
    u, v = np.meshgrid(np.linspace(0, 1, 301), np.linspace(0, 1, 301))
    inside = u + v <= 1
    u, v = u[inside][:, None], v[inside][:, None]
    found = np.linalg.norm(closest_point_on_triangle(p, a, b, c) - p, axis=1)
    for i in range(60):
        grid = a[i] + u * (b[i] - a[i]) + v * (c[i] - a[i])
        dense = np.linalg.norm(grid - p[i], axis=1).min()
        assert found[i] <= dense + 1e-9
        assert found[i] > dense - 0.02


def test_distance_to_a_mesh_does_not_see_its_samples():
    """Samples lie half a metre apart here; the distance is still that to the plane."""
    distance = SurfaceDistance(plane(0.0, half=80.0, cells=2))
    points = np.random.default_rng(0).uniform([-70, 1, 0.3], [-1, 70, 0.3], (500, 3))
    assert np.abs(distance(points) - 0.3).max() < 1e-12
    cloud = SurfaceDistance(Surface(np.zeros((1, 3)), NO_FACES))
    assert cloud(np.array([[3.0, 4.0, 0.0]])) == pytest.approx([5.0])


def test_icp_finds_a_small_motion_of_a_corner(monkeypatch):
    corner = joined(
        plane(0.0),
        Surface(plane(0.0).vertices[:, [2, 0, 1]] - [1, 0, -1], plane(0.0).faces),
        Surface(plane(0.0).vertices[:, [0, 2, 1]] - [0, 1, -1], plane(0.0).faces),
    )
    xi = torch.tensor([0.02, -0.015, 0.01, 0.01, -0.02, 0.015], dtype=torch.float64)
    T = se3_exp(xi).numpy()
    points = sample_surface(corner.transformed(T), 5000, np.random.default_rng(0))[0]
    found = icp(points, SurfaceDistance(corner))
    assert np.abs(found @ T - np.eye(4)).max() < 1e-4
    cloud = sample_surface(corner, 40_000, np.random.default_rng(1))[0]
    monkeypatch.setattr("geogs.evaluation.surfaces.icp._ITERATIONS", 60)
    found = icp(points, SurfaceDistance(Surface(cloud, NO_FACES)))
    assert np.abs(found @ T - np.eye(4)).max() < 3e-3
    far = icp(points + 5, SurfaceDistance(corner))
    assert np.array_equal(far, np.eye(4))


def test_icp_does_not_slide_along_a_single_plane():
    points = sample_surface(plane(0.03), 5000, np.random.default_rng(0))[0]
    T = icp(points, SurfaceDistance(plane(0.0)))
    assert T[2, 3] == pytest.approx(-0.03, abs=1e-6)
    assert np.abs(T[:2, 3]).max() < 1e-6


def test_icp_in_the_evaluation_takes_out_a_shift():
    s = evaluate_reconstruction(plane(1.03), plane(1.0), samples=2000, use_icp=True).scores
    assert s.accuracy_cm < 1e-3
    assert s.icp_shift_cm == pytest.approx(3.0, abs=1e-3)


def test_raster_is_exact_also_across_the_near_plane():
    """A floor from behind the camera to the horizon: depth = height / slope of the ray."""
    floor = Surface(
        np.array([[-50.0, 1.0, -20.0], [50, 1, -20], [50, 1, 60], [-50, 1, 60]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    depth, face = render_mesh(floor.vertices, floor.faces, CAMERA, np.eye(4))
    rays = CAMERA.rays(torch.float64).numpy()
    expected = np.where(rays[..., 1] > 1 / 60, 1 / np.maximum(rays[..., 1], 1e-9), np.inf)
    expected[np.abs(rays[..., 0] * expected) > 50] = np.inf
    assert np.array_equal(np.isinf(depth), np.isinf(expected))
    hit = np.isfinite(expected)
    assert np.abs(depth[hit] / expected[hit] - 1).max() < 1e-9
    assert np.array_equal(face >= 0, hit)


def test_raster_keeps_the_nearest_and_leaves_no_cracks():
    depth, face = render_mesh(*_arrays(joined(plane(2.0), plane(1.0, 0.3))), CAMERA, np.eye(4))
    near = np.abs(CAMERA.rays(torch.float64).numpy()[..., :2]).max(-1) < 0.3
    assert depth[near] == pytest.approx(1.0)
    inner = ~near & (np.abs(CAMERA.rays(torch.float64).numpy()[..., :2]).max(-1) < 0.49)
    assert np.allclose(depth[inner], 2.0)
    assert (face[near] >= len(plane(2.0).faces)).all()


def _arrays(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    return surface.vertices, surface.faces


def test_culling_removes_what_is_hidden_and_what_is_outside():
    screen, wall = plane(1.0, half=0.3), plane(2.0, half=3.0, cells=20)
    scene = joined(screen, wall)
    visibility = Visibility(scene, CAMERA, np.eye(4)[None])
    points = np.array([
        [0.0, 0.0, 1.0],  # on the screen
        [0.0, 0.0, 2.0],  # behind it
        [1.0, 0.0, 2.0],  # on the wall beside it
        [2.9, 0.0, 2.0],  # outside the image
        [0.0, 0.0, -1.0],  # behind the camera
        [0.0, 0.0, 0.5],  # free space in front
        [0.0, 0.0, 1.02],  # within the tolerance
        [0.0, 0.0, 1.05],
    ])  # fmt: skip
    assert visibility.seen(points).tolist() == [
        True, False, True, False, False, True, True, False,
    ]  # fmt: skip
    aside = np.eye(4)
    aside[0, 3] = -2.0  # a second camera two metres to the right sees behind the screen
    both = Visibility(scene, CAMERA, np.stack([np.eye(4), aside]))
    assert both.seen(points)[3]


def test_culled_scores_count_seen_parts_only():
    screen, wall = plane(1.0, half=0.3), plane(2.0, half=3.0, cells=20)
    truth = joined(screen, wall)
    visible = Visibility(truth, CAMERA, np.eye(4)[None])
    # The reconstruction lacks the wall outside the image and has a sheet hidden behind the wall.
    front = plane(2.0, half=1.6, cells=32)
    hole = np.abs(front.vertices[front.faces][..., :2]).max((1, 2)) > 0.5
    seen_wall = Surface(front.vertices, front.faces[hole])
    reconstruction = joined(screen, seen_wall, plane(3.0, half=1.0))
    plain = evaluate_reconstruction(reconstruction, truth, samples=20000).scores
    culled = evaluate_reconstruction(
        reconstruction, truth, None, visible, cull_reconstruction=True, samples=20000
    ).scores
    assert plain.completeness_ratio < 45
    assert plain.precision_ratio < 75
    assert culled.completeness_ratio > 98
    assert culled.precision_ratio == 100.0


def test_cameras_that_see_nothing_are_an_input_error():
    away = np.diag([1.0, -1.0, -1.0, 1.0])[None]
    with pytest.raises(InputError, match="are the poses in its frame"):
        evaluate_reconstruction(
            plane(1.0), plane(1.0), None, Visibility(plane(1.0), CAMERA, away), samples=100
        )


def test_read_surface_of_our_mesh_of_polygons_and_of_points(tmp_path):
    surface = plane(1.5)
    write_mesh(tmp_path / "m.ply", surface.vertices, surface.faces)
    read = read_surface(tmp_path / "m.ply")
    assert np.allclose(read.vertices, surface.vertices)
    assert np.array_equal(read.faces, surface.faces)
    (tmp_path / "q.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2\nproperty list uchar int vertex_index\nend_header\n"
        "0 0 0\n1 0 0\n1 1 0\n0 1 0\nnan 0 0\n4 0 1 2 3\n3 0 1 4\n"
    )
    quad = read_surface(tmp_path / "q.ply")
    assert quad.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert len(quad.vertices) == 4
    assert quad.areas.sum() == pytest.approx(1.0)
    (tmp_path / "p.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\n"
        "property double z\nend_header\n0 0 0\n1 2 3\n"
    )
    assert not read_surface(tmp_path / "p.ply").is_mesh


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (None, "does not exist"),
        (b"solid nothing", "no readable PLY"),
        (b"", "no readable PLY"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\n"
         b"property float y\nproperty float z\nend_header\n\0\0", "no readable PLY"),
        (b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\n"
         b"property float z\nend_header\n", "no vertices"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
         b"property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
         b"0 0 0\n3 0 1 2\n", "not there"),
    ],
)  # fmt: skip
def test_unreadable_surfaces_are_input_errors(tmp_path, content, match):
    path = tmp_path / "bad.ply"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=match):
        read_surface(path)
