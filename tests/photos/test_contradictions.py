"""Worlds whose parts are joined with a wrong turn are cut there, others are not."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs_photos import contradictions
from geogs_photos.contradictions import (
    Vote,
    best_rotation,
    false_pairs,
    speaks_for,
    undisputed,
    undivided,
)
from geogs_photos.verified_matches import PairMatches

FOCAL = 375.0


def horizon(turn: float, count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Rays to points far away on the horizon, before and after a turn about y, degrees."""
    random = np.random.default_rng(0)
    x = random.uniform(-0.3, 0.3, count)
    one = np.stack([x, np.zeros(count), np.ones(count)], -1)
    two = one @ Rotation.from_euler("y", turn, degrees=True).as_matrix().T
    return one, two / two[:, 2:]


def pair(turn: float, claimed: float) -> PairMatches:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", claimed, degrees=True).as_matrix()
    T[:3, 3] = 1.0, 0.0, 0.3
    return PairMatches(1, 2, T, horizon(turn), FOCAL)


def test_a_turn_is_found_beside_false_matches():
    one, two = horizon(12.0)
    two[::4, 1] += 0.3
    R, off = best_rotation(one, two)
    assert Rotation.from_matrix(R).magnitude() == pytest.approx(np.radians(12), abs=0.01)
    assert (off < 0.01).sum() == 30


def test_matches_on_epipolar_lines_contradict_another_turn():
    """Poses that turn by 53 degrees, where the images do by 12, agree with all lines."""
    assert pair(12.0, 53.0).epipolar().max() < 0.01
    assert speaks_for(pair(12.0, 53.0)) == -40
    assert speaks_for(pair(12.0, 10.0)) == 40
    one, two = horizon(12.0)
    off = PairMatches(1, 2, pair(12.0, 10.0).T, (one, two + np.array([0, 0.1, 0])), FOCAL)
    assert speaks_for(off) == -40


def test_matches_of_a_twisted_pair_speak_against_it():
    """Half a turn about the line to the other camera leaves all matches on their lines."""
    random = np.random.default_rng(0)
    points = random.uniform([-2, -1, 3], [2, 1, 8], (40, 3))
    T, t = np.eye(4), np.array([1.0, 0.1, 0.2])
    T[:3, 3] = t
    moved = points + t
    rays = points / points[:, 2:], moved / moved[:, 2:]
    assert speaks_for(PairMatches(1, 2, T, rays, FOCAL)) == 40
    T[:3, :3] = Rotation.from_rotvec(np.pi * t / np.linalg.norm(t)).as_matrix()
    twisted = PairMatches(1, 2, T, rays, FOCAL)
    assert twisted.epipolar().max() < 0.01
    assert speaks_for(twisted) == -40


def test_the_cut_is_where_more_speaks_against_the_poses():
    def votes(across: int) -> list[Vote]:
        inside = [(i, j, 50) for i in range(6) for j in range(i) if (i < 4) == (j < 4)]
        return [Vote(*v) for v in [*inside, (3, 4, across), (2, 5, 20), (1, 4, -30)]]

    parts = undivided(6, [*votes(15), Vote(3, 5, -30)])
    assert sorted(map(sorted, parts)) == [[0, 1, 2, 3], [4, 5]]
    assert undivided(6, votes(15)) == [[0, 1, 2, 3, 4, 5]]
    assert undivided(6, [Vote(0, 1, -3)]) != [[0, 1, 2, 3, 4, 5]]


@pytest.mark.parametrize(
    ("corner", "sides"), [((-31, 0), 2), ((-31, 10), 2), ((-31, 16), 1), ((-8, 0), 1), ((40, 0), 1)]
)
def test_frames_that_follow_one_another_outvote_sides_that_look_alike(corner, sides):
    """Round a building: its sides 0 to 4 and 5 to 9 look alike, and few matches pass the corner."""
    along = [Vote(k, k + 1, 40, True) for k in range(9) if k != 4]
    alike = [Vote(k, k + 5, 400) for k in range(5)]
    passing = [Vote(4, 5, corner[0], True), Vote(3, 6, corner[1], True)]
    parts = sorted(map(sorted, undivided(10, [*along, *alike, *passing])))
    assert parts == ([list(range(10))] if sides == 1 else [list(range(5)), list(range(5, 10))])


def test_the_smaller_part_of_a_broken_world_loses_its_poses(monkeypatch):
    """A pair that speaks for the joint is false."""
    kept = set(range(1, 7))
    images = {n: SimpleNamespace(image_id=n, has_pose=True, frame_id=n) for n in kept}
    model = SimpleNamespace(images=images, deregister_frame=kept.remove, tear_down=lambda: None)
    claims = {(i, j): 53.0 if (i < 5) != (j < 5) else 10.0 for i in kept for j in kept if i < j}
    claims[2, 5] = 10.0
    pairs = [PairMatches(*n, (p := pair(12.0, c)).T, p.rays, FOCAL) for n, c in claims.items()]
    monkeypatch.setattr(contradictions, "verified_matches", lambda *_: iter(pairs))
    assert false_pairs(model, Path("database")) == [(2, 5)]
    undisputed(model, Path("database"))
    assert kept == {1, 2, 3, 4}
