"""Which photographs are matched with which."""

import numpy as np

from geogs_photos import photo_pairs as pairs_module
from geogs_photos.photo_features import PhotoFeatures
from geogs_photos.photo_pairs import choose_pairs, mutual_matches, vlad


def descriptors(random: np.random.Generator, count: int) -> np.ndarray:
    raw = random.gamma(0.4, 1.0, (count, 128))
    return np.round(512 * np.sqrt(raw / raw.sum(1, keepdims=True))).clip(0, 255).astype(np.uint8)


def features(some: np.ndarray) -> PhotoFeatures:
    keypoints = np.ones((len(some), 4), np.float32)
    return PhotoFeatures(keypoints, some)


def walk(random: np.random.Generator, pictures: int, step: int = 20, window: int = 60):
    """Pictures that see neighbouring windows of one long row of features."""
    row = descriptors(random, pictures * step + window)
    return [features(row[i * step : i * step + window]) for i in range(pictures)]


def test_matches_are_mutual_and_clear():
    random = np.random.default_rng(0)
    some = descriptors(random, 50).astype(np.float32)
    noisy = some[::-1][:30] + random.normal(0, 1, (30, 128)).astype(np.float32)
    assert mutual_matches(some, noisy) == 30
    distance = np.linalg.norm(some[:, None] - noisy[None], axis=2)  # the obvious way
    expected = 0
    for i, row in enumerate(distance):
        nearest, second = np.sort(row)[:2]
        j = int(row.argmin())
        expected += nearest < 0.85 * second and int(distance[:, j].argmin()) == i
    assert mutual_matches(some, noisy) == expected
    assert mutual_matches(some, some[:1]) == 0


def test_of_few_pictures_every_pair_is_matched():
    random = np.random.default_rng(1)
    assert len(choose_pairs(walk(random, 6))) == 15


def test_of_more_those_that_share_something_and_neighbours():
    random = np.random.default_rng(2)
    chosen = set(choose_pairs(walk(random, 40)))
    assert {(i, i + 1) for i in range(39)} <= chosen
    assert {(i, i + 2) for i in range(38)} <= chosen
    assert len([p for p in chosen if p[1] - p[0] > 3]) < 0.2 * len(chosen)


def test_of_many_a_place_seen_again_is_still_found(monkeypatch):
    monkeypatch.setattr(pairs_module, "ALL_PREVIEWS", 30)
    monkeypatch.setattr(pairs_module, "_CANDIDATES", 10)
    random = np.random.default_rng(3)
    there = walk(random, 40)
    again = [features(f.descriptors[::-1].copy()) for f in there[:5]]
    chosen = set(choose_pairs([*there, *again]))
    assert {(k, 40 + k) for k in range(5)} <= chosen
    assert len(chosen) < 0.6 * 45 * 44 / 2


def test_looks_are_unit_vectors_that_are_alike_where_pictures_are():
    random = np.random.default_rng(4)
    one, other = descriptors(random, 300), descriptors(random, 300)
    looks = vlad([one, one[::2], other, np.zeros((0, 128), np.uint8)])
    np.testing.assert_allclose(np.linalg.norm(looks[:3], axis=1), 1, atol=1e-5)
    assert np.linalg.norm(looks[3]) == 0
    assert looks[0] @ looks[1] > looks[0] @ looks[2] + 0.1
