"""The scripts' own reconstruction measures, against surfaces whose distances are known."""

import numpy as np
import pytest
import torch

from geogs.errors import InputError
from geogs.evaluation.surfaces.icp import icp_points
from geogs.evaluation.surfaces.surface import Surface
from geogs.evaluation.surfaces.toolbox import (
    AREA_WEIGHTED,
    VERTEX_WEIGHTED,
    evaluate_samples,
    evaluate_vertices,
)
from geogs.evaluation.surfaces.visibility import cull_mesh, in_frustum
from geogs.geometry.lie import se3_exp
from surface_shapes import CAMERA, NO_FACES, joined, plane


def test_coarse_truth_is_sampled_and_fine_truth_is_not():
    """Truth of four vertices 2 m apart, reconstruction 1 cm above it with 101 x 101 vertices."""
    fine, coarse = plane(1.01, cells=100), plane(1.0, cells=1)
    s = evaluate_vertices(fine, coarse, use_icp=False).scores
    # Vertices to 10201 independent samples of 4 square metres (1/(2 sqrt(density)) = 0.99 cm).
    assert s.accuracy_cm == pytest.approx(np.hypot(1.0, 1.0), abs=0.15)
    assert s.completeness_cm == pytest.approx(1.0, abs=1e-9)  # corner to corner
    assert (s.accuracy_samples, s.completeness_samples) == (101**2, 4)
    assert s.protocol == VERTEX_WEIGHTED
    s = evaluate_vertices(coarse, fine, use_icp=False).scores
    assert s.accuracy_cm == pytest.approx(1.0, abs=1e-9)  # to the true vertices
    assert s.completeness_cm == pytest.approx(np.hypot(1.0, 1.0), abs=0.15)
    assert (s.accuracy_samples, s.completeness_samples) == (4, 101**2)


def test_vertices_weigh_and_not_areas():
    """A dense metre is right, a coarse one is 4 cm off, a third metre is 6 cm off."""
    dense = plane(0.0, half=0.5, cells=19)  # 400 vertices
    aside = np.eye(4)
    aside[0, 3] = 3.0
    low = plane(0.04, half=0.5, cells=9).transformed(aside)
    lower = plane(0.06, half=0.5, cells=9).transformed(aside @ aside)
    flat = [Surface(p.vertices * [1, 1, 0], p.faces) for p in (low, lower)]
    s = evaluate_vertices(joined(dense, low, lower), joined(dense, *flat), use_icp=False).scores
    assert s.accuracy_cm == pytest.approx((0 * 400 + 4 * 100 + 6 * 100) / 600)
    assert s.precision_ratio == pytest.approx(100 * 5 / 6)


def test_duplicate_and_loose_vertices_do_not_count():
    whole = plane(1.0, cells=6)
    corners = whole.vertices[whole.faces].reshape(-1, 3)
    soup = Surface(np.concatenate([corners, [[9.0, 9, 9]]]), np.arange(len(corners)).reshape(-1, 3))
    s = evaluate_vertices(soup, whole, use_icp=False).scores
    assert s.accuracy_samples == 49
    assert s.accuracy_cm == 0.0


def test_duplicates_are_those_that_trimesh_merges():
    trimesh = pytest.importorskip("trimesh")
    from geogs.evaluation.surfaces.toolbox import _without_duplicates

    rng = np.random.default_rng(0)
    vertices = plane(1.0, cells=6).vertices[plane(1.0, cells=6).faces].reshape(-1, 3)
    vertices = np.concatenate([vertices + rng.choice([0, 1e-7], vertices.shape), [[5.0, 5, 5]]])
    faces = np.arange(len(vertices) - 1).reshape(-1, 3)
    ours = _without_duplicates(Surface(vertices, faces)).vertices
    theirs = trimesh.Trimesh(vertices, faces).vertices
    assert len(ours) == len(theirs)
    assert np.allclose(np.sort(ours, axis=0), np.sort(theirs, axis=0))


def test_samples_to_samples_have_a_floor_and_agree_above_it():
    s = evaluate_samples(plane(1.0), plane(1.0), use_icp=False, samples=10_000).scores
    spacing = 100 / (2 * np.sqrt(10_000 / 4))  # mean distance to the nearest of random points
    assert s.accuracy_cm == pytest.approx(spacing, rel=0.05)
    assert s.completeness_cm == pytest.approx(spacing, rel=0.05)
    assert s.protocol == AREA_WEIGHTED
    far = evaluate_samples(plane(1.2), plane(1.0), use_icp=False, samples=10_000).scores
    assert far.chamfer_cm == pytest.approx(20.0, abs=0.06)
    assert far.f_score == 0.0


@pytest.mark.parametrize("evaluate", [evaluate_vertices, evaluate_samples])
def test_icp_of_vertices_comes_first(evaluate):
    moved = plane(1.03, cells=60).transformed(np.eye(4))
    s = evaluate(moved, plane(1.0, cells=60)).scores
    assert s.icp_shift_cm == pytest.approx(3.0, abs=1e-6)
    with pytest.raises(InputError, match="truth has no triangles"):
        evaluate(moved, Surface(moved.vertices, NO_FACES))


def test_icp_of_points_finds_a_motion_and_keeps_far_points_where_they_are():
    points = np.random.default_rng(0).uniform(-1, 1, (3000, 3))
    T = se3_exp(torch.tensor([0.01, -0.01, 0.005, 0.004, 0.003, -0.005]).double()).numpy()
    found = icp_points(points @ T[:3, :3].T + T[:3, 3], points)
    assert np.abs(found @ T - np.eye(4)).max() < 1e-6
    assert np.array_equal(icp_points(points + 9, points), np.eye(4))


def test_meshes_are_culled_by_the_two_rules():
    screen, wall = plane(1.0, half=0.3), plane(2.0, half=6.0, cells=48)
    scene, view = joined(screen, wall), np.eye(4)[None]
    frustum = cull_mesh(scene, CAMERA, view, "frustum")
    # The image is 1.6 by 1.2 wide at depth 1; triangles with one vertex inside stay.
    low, high = frustum.vertices.min(0), frustum.vertices.max(0)
    assert np.allclose([low[0], high[0], low[1], high[1]], [-1.75, 1.75, -1.25, 1.25])
    seen = cull_mesh(scene, CAMERA, view, "occlusion")
    middle = seen.vertices[seen.vertices[:, 2] == 2.0]
    hidden = np.abs(middle[:, :2]).max(1) < 0.3  # the screen's shadow is 0.6 wide each way
    assert not hidden.any()
    assert len(seen.vertices) < len(frustum.vertices)
    assert seen.vertices[:, 2].min() == 1.0
    away = np.diag([1.0, -1.0, -1.0, 1.0])[None]
    with pytest.raises(InputError, match="no part of a mesh"):
        cull_mesh(scene, CAMERA, away, "frustum")
    assert in_frustum(np.array([[0, 0, -1.0], [0, 0, 1]]), CAMERA, away).tolist() == [True, False]
