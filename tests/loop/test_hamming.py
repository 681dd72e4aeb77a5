"""Nearest descriptors by the bits that differ, against all distances written out."""

import cv2
import numpy as np
import pytest

from geogs.loop.hamming_kernels import two_nearest
from geogs.loop.orb_features import orb_features
from geogs.loop.verification import MATCH_RATIO, FeatureView, TwoViewVerifier
from lit_rooms import lit_room
from loop_scenes import CAMERA, orbit, room_views


def descriptors(count: int, seed: int, differing: int = 256) -> np.ndarray:
    """Random ones, of which only the first so many bits differ, so that many are equally near."""
    bits = np.random.default_rng(seed).integers(0, 2, (count, 256), np.uint8)
    bits[:, differing:] = 0
    return np.packbits(bits, axis=1)


@pytest.mark.parametrize("differing", [256, 6])
@pytest.mark.parametrize("targets", [0, 1, 2, 90])
def test_two_nearest_are_those_of_all_distances(targets, differing):
    source, target = descriptors(70, 1, differing), descriptors(targets, 2, differing)
    index, nearest, second = two_nearest(source.view(np.uint64), target.view(np.uint64))
    distances = np.bitwise_count(source[:, None] ^ target).sum(-1)
    padded = np.pad(distances, ((0, 0), (0, 2)), constant_values=257)
    in_order = np.sort(padded, axis=1)
    np.testing.assert_array_equal(nearest, in_order[:, 0])
    np.testing.assert_array_equal(second, in_order[:, 1])
    if targets:
        np.testing.assert_array_equal(index, distances.argmin(1))


def test_features_match_where_each_is_clearly_nearest_to_the_other():
    first, second = (orb_features(v.image) for v in room_views(3, orbit(lit_room(3).scene, 72)[:2]))
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)

    def distinct(a, b):
        pairs = matcher.knnMatch(a.descriptors, b.descriptors, k=2)
        return {(m.queryIdx, m.trainIdx) for m, n in pairs if m.distance < MATCH_RATIO * n.distance}

    mutual = distinct(first, second) & {(i, j) for j, i in distinct(second, first)}
    assert len(mutual) > 50
    verifier = TwoViewVerifier(CAMERA)
    found = verifier.verify(FeatureView(first), FeatureView(second))
    assert found.matches == len(mutual)


def test_descriptors_of_a_checkpoint_may_lie_at_any_byte():
    source, target = descriptors(20, 1), descriptors(30, 2)
    shifted = np.frombuffer(b"." + target.tobytes(), np.uint8)[1:].reshape(target.shape)
    expected = two_nearest(source.view(np.uint64), target.view(np.uint64))
    found = two_nearest(source.view(np.uint64), shifted.view(np.uint64))
    for there, true in zip(found, expected, strict=True):
        np.testing.assert_array_equal(there, true)
