"""Worlds whose parts are joined with a wrong turn are cut there, others are not."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs.application.structure_from_motion.chosen_frames import ChosenFrames
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.types import Frame
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
from geogs_photos.video import place_frames

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


FOCAL = 350.0


def turning(arm: float, times: float, seed: int) -> list[PairMatches]:
    """Pairs of ten views turned by 5 degrees each at the end of an ``arm``, of points 2 to 5 away,
    through a lens that is taken for so many times longer; each match is 0.3 pixels off."""
    random = np.random.default_rng(seed)
    T_cw = np.tile(np.eye(4), (10, 1, 1))
    turns = Rotation.from_euler("yx", [(5 * k, 4 * np.sin(k)) for k in range(10)], degrees=True)
    T_cw[:, :3, :3] = turns.inv().as_matrix()
    T_cw[:, 2, 3] = -arm
    pairs = []
    for i in range(10):
        for j in range(i + 1, min(i + 5, 10)):
            ahead = np.c_[random.uniform(-0.7, 0.7, (300, 2)), np.ones(300)]
            points = random.uniform(2, 5, (300, 1)) * ahead
            T = T_cw[j] @ np.linalg.inv(T_cw[i])
            there = points @ T[:3, :3].T + T[:3, 3]
            rays = [x / x[:, 2:] for x in (points, there)]
            inside = (np.abs(rays[1][:, :2]) < 0.7).all(1)
            bent = [x[inside] / [times, times, 1.0] for x in rays]
            for x in bent:
                x[:, :2] += random.normal(0, 0.3 / (times * FOCAL), (len(x), 2))
            pairs.append(PairMatches(i + 1, j + 1, T, (bent[0], bent[1]), times * FOCAL))
    return pairs


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    ("arm", "times"), [(0.0, 0.85), (0.0, 0.9), (0.0, 1.0), (0.0, 1.15), (0.1, 1.0), (0.25, 1.0)]
)
def test_a_turn_alone_is_told_from_one_at_arms_length(arm, times, seed, monkeypatch):
    pairs = turning(arm, times, seed)
    if not arm:  # poses of a made-up world explain what is left to a fifth of a pixel
        lines = np.random.default_rng(seed)
        monkeypatch.setattr(
            PairMatches, "epipolar", lambda p: np.abs(lines.normal(0, 0.2, len(p.rays[0])))
        )
    monkeypatch.setattr(contradictions, "verified_matches", lambda *_: iter(pairs))
    model = SimpleNamespace(images={}, compute_mean_reprojection_error=lambda: 0.3)
    assert contradictions.only_rotates(model, Path("database")) is (arm == 0.0)


@pytest.mark.system
def test_a_panorama_through_a_wrong_focal_length_is_no_world():
    pytest.importorskip("pycolmap")
    random = np.random.default_rng(3)
    coarse = random.integers(0, 255, (60, 120, 3), dtype=np.uint8)
    panorama = cv2.resize(coarse, (480, 240), interpolation=cv2.INTER_CUBIC)
    K, wide = (np.array([[100.0, 0, x], [0, 100, y], [0, 0, 1]]) for x, y in (
        (63.5, 47.5), (239.5, 119.5)
    ))  # fmt: skip
    frames = []
    for k in range(12):
        R = Rotation.from_euler("y", 2.2 * k - 12, degrees=True).as_matrix()
        image = cv2.warpPerspective(panorama, K @ R @ np.linalg.inv(wide), (128, 96))
        frames.append(Frame(k, k / 10, image))
    chosen = ChosenFrames(tuple(frames), np.arange(12) / 10)
    camera = Camera(90.0, 90.0, 63.5, 47.5, 128, 96)
    with pytest.raises(InputError, match="only turns"):
        place_frames(chosen, camera, True, False, False, 0, lambda *_: None)
