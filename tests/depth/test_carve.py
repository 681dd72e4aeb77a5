"""Votes of the views on points."""

import numpy as np
import pytest

from depth_scene import RENDER, make_scene, trace
from geogs.depth.carve import count_votes, look_up, vote
from geogs.depth.depth_view import KeyframeDepth


def both(poses, depths):
    """Poses with their depths."""
    return list(zip(poses, depths, strict=True))


@pytest.fixture(scope="module")
def seen():
    scene = make_scene()
    poses = [v.T_cw for v in scene.views]
    depths = [KeyframeDepth(t, np.full_like(t, 0.9)) for t in scene.truth]
    points = trace(RENDER, np.linalg.inv(poses[0]))[1][12:-12:6, 12:-12:6].reshape(-1, 3)
    return points, poses, depths


def test_surface_points_stay_and_floaters_go(seen):
    points, poses, depths = seen
    assert vote(points, both(poses, depths), RENDER).all()
    floaters = 0.7 * points
    assert not vote(floaters, both(poses, depths), RENDER).any()
    surface, free = count_votes(floaters, both(poses, depths), RENDER)
    assert (surface == 0).all()
    assert (free >= 3).mean() > 0.9


def test_points_behind_the_surface_or_unseen_are_not_judged(seen):
    points, poses, depths = seen
    assert vote(3.0 * points, both(poses, depths), RENDER).all()
    assert vote(-points, both(poses, depths), RENDER).all()
    surface, free = count_votes(-points, both(poses, depths), RENDER)
    assert (surface == 0).all()
    assert (free == 0).all()


def test_one_view_or_an_unsure_one_cannot_remove(seen):
    points, poses, depths = seen
    floaters = 0.7 * points
    assert vote(floaters, both(poses[:1], depths[:1]), RENDER).all()
    unsure = [KeyframeDepth(d.depth, np.full_like(d.depth, 0.2)) for d in depths]
    assert vote(floaters, both(poses, unsure), RENDER).all()
    assert vote(floaters, [], RENDER).all()


def test_support_outweighs_as_many_violations(seen):
    points, poses, depths = seen
    floaters = 0.7 * points
    lifted = KeyframeDepth((0.7 * depths[0].depth).astype(np.float32), depths[0].confidence)
    views = [lifted, lifted, *depths[:2]]
    kept = vote(floaters, both([poses[0], poses[0], *poses[:2]], views), RENDER)
    assert kept.mean() > 0.95


def test_points_that_are_not_finite_go(seen):
    points, poses, depths = seen
    broken = points[:4].copy()
    broken[0, 0], broken[1, 2] = np.nan, np.inf
    assert vote(broken, both(poses, depths), RENDER).tolist() == [False, False, True, True]
    assert vote(np.empty((0, 3)), both(poses, depths), RENDER).shape == (0,)


def test_depth_zero_does_not_vote(seen):
    points, poses, depths = seen
    empty = KeyframeDepth(0 * depths[0].depth, depths[0].confidence)
    ratio, sure = look_up(points.astype(np.float32), poses[0], empty, RENDER)
    assert (ratio == 0).all()
    assert (sure == 0).all()


def test_ratio_is_depth_of_the_point_over_that_of_the_view(seen):
    points, poses, depths = seen
    ratio, sure = look_up((0.8 * points).astype(np.float32), poses[0], depths[0], RENDER)
    assert np.abs(ratio - 0.8).max() < 1e-4
    assert np.allclose(sure, 0.9)
