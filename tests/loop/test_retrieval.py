"""Appearance retrieval: places seen again are found, without training data and at any exposure."""

import numpy as np
import pytest

from geogs.loop.orb_features import orb_features
from geogs.loop.retrieval import AppearanceIndex
from lit_rooms import lit_room
from loop_scenes import orbit, room_views

LAP = 18


@pytest.fixture(scope="module")
def lap() -> list[np.ndarray]:
    """Images once around a room, 20 degrees apart."""
    return [v.image for v in room_views(3, orbit(lit_room(3).scene, LAP))]


@pytest.fixture(scope="module")
def again() -> list[np.ndarray]:
    """Four of the places, seen from 5 degrees aside."""
    return [v.image for v in room_views(3, orbit(lit_room(3).scene, LAP, np.radians(5))[::5])]


@pytest.fixture(scope="module")
def index(lap: list[np.ndarray]) -> AppearanceIndex:
    """All of the lap."""
    index = AppearanceIndex()
    for n, image in enumerate(lap):
        index.add(100 + n, orb_features(image))
    return index


def test_features_are_spread_and_strongest_first(lap):
    features = orb_features(lap[0], most=240)
    assert len(features) == len(features.descriptors) <= 240
    cells = (features.pixels // [48, 48]).astype(int) @ [1, 8]
    # The first of every cell come before the second of any.
    assert len(np.unique(cells[:30])) > 20


def test_finds_the_place_that_is_seen_again(index, again):
    for n, image in enumerate(again):
        found = index.query(orb_features(image), count=3)
        assert found[0].keyframe == 100 + 5 * n


def test_excluded_keyframes_are_never_returned(index, again):
    found = index.query(orb_features(again[0]), exclude={100, 101}, count=50)
    assert found
    assert not {100, 101} & {c.keyframe for c in found}


def test_an_image_is_most_like_itself(index, lap):
    best = index.query(orb_features(lap[7]), count=1)[0]
    assert best.keyframe == 107
    assert best.score > 0.9


@pytest.mark.parametrize("gain", [0.45, 0.7, 1.5])
def test_exposure_does_not_matter(index, again, gain):
    for n, image in enumerate(again):
        exposed = np.clip(gain * image.astype(float), 0, 255).astype(np.uint8)
        best = {c.keyframe for c in index.query(orb_features(exposed), count=2)}
        assert 100 + 5 * n in best


@pytest.mark.long
def test_other_rooms_score_far_less(index, again):
    here = min(index.query(orb_features(image), count=1)[0].score for image in again)
    for view in room_views(5, orbit(lit_room(5).scene, 4)):
        there = index.query(orb_features(view.image), count=1)
        assert not there or there[0].score < 0.3 * here


def test_same_order_gives_same_scores(lap, again):
    def run() -> list[tuple[int, float]]:
        index = AppearanceIndex()
        for n, image in enumerate(lap):
            index.add(n, orb_features(image))
        return [(c.keyframe, c.score) for image in again for c in index.query(orb_features(image))]

    assert run() == run()


def test_featureless_images_find_nothing(lap):
    index = AppearanceIndex()
    grey = orb_features(np.full_like(lap[0], 90))
    assert index.query(grey) == []
    index.add(0, grey)
    index.add(1, orb_features(lap[0]))
    assert index.query(grey) == []
    assert index.query(orb_features(lap[1]), exclude={1}) == []
    assert len(index) == 2


def test_a_full_vocabulary_still_finds_places(lap, again):
    index = AppearanceIndex(most_words=2500)
    for n, image in enumerate(lap):
        index.add(n, orb_features(image))
    hits = [index.query(orb_features(image), count=3) for image in again]
    assert all(5 * n in {c.keyframe for c in found} for n, found in enumerate(hits))


def test_scores_are_those_of_comparing_word_by_word(index, lap, again):
    """Shared mass of words, each as often as it is in both, over the image's own mass."""
    features = orb_features(again[0])
    words, distance = index._nearest(features)
    known = words[distance <= index._radius].tolist()
    rows = len(index)
    expected, own = np.zeros(rows), (len(words) - len(known)) * np.log((rows + 1) / 0.5)
    for word in sorted({*known}):
        held = dict(index._postings[word].rows.tolist())
        weight = max(np.log((rows + 1) / (len(held) + 0.5)), 0.0)
        own += weight * known.count(word)
        for row, count in held.items():
            expected[row] += weight * min(count, known.count(word))
    found = index.query(features, count=rows)
    assert len(found) > 3
    for candidate in found:
        row = index._vocabulary.keyframes.index(candidate.keyframe)
        assert candidate.score == pytest.approx(expected[row] / own, rel=1e-12)
    other = AppearanceIndex(vocabulary=index._vocabulary)
    assert other.query(features, count=rows) == found
