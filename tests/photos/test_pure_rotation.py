"""A turn seen through a wrong focal length is no world; one beside a small step is."""

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
from geogs_photos import pure_rotation
from geogs_photos.verified_matches import PairMatches
from geogs_photos.video import place_frames

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
    monkeypatch.setattr(pure_rotation, "verified_matches", lambda *_: iter(pairs))
    model = SimpleNamespace(images={}, compute_mean_reprojection_error=lambda: 0.3)
    assert pure_rotation.only_rotates(model, Path("database")) is (arm == 0.0)


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
