"""What is known of a part's keyframes, and which of them look alike."""

import numpy as np
import pytest

from geogs.config import Config
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.loop.orb_features import orb_features
from geogs.world.grid import SampleGrid
from geogs.world.loops import ImageFeatures
from geogs_fleet.join.links import candidates
from geogs_fleet.join.part import Part, PartViews, describe, opened, resampled
from geogs_fleet.join.records import read_record
from joined_parts import CAMERA, image, make_part, pose, seen, walls
from saved_results import make_result


def test_another_camera_at_the_same_place_sees_the_same():
    other = Camera(150.0, 155.0, 118.0, 91.0, 230, 176)
    T, paint = pose(0.0), walls(0)
    given = resampled(image(T, paint), CAMERA, other).astype(float)
    assert given.shape == (176, 230, 3)
    away = np.abs(given - image(T, paint, other))[10:-10, 10:-10]
    shifted = np.abs(given - np.roll(image(T, paint, other), 1, axis=1))[10:-10, 10:-10]
    assert away.mean() < 4 < shifted.mean()
    assert resampled(image(T, paint), CAMERA, CAMERA).shape == (192, 256, 3)


def test_a_part_is_described_by_the_depths_that_its_map_shows(tmp_path):
    part = Part("a", make_part(tmp_path / "a", np.array([0.0, 0.1]), 0))
    file = tmp_path / "views.safetensors"
    assert describe(part, CAMERA, file) == 2
    views, grid = read_record(PartViews, file), SampleGrid(CAMERA)
    for n, s in enumerate((0.0, 0.1)):
        depth = seen(pose(s), CAMERA)[0]
        x, y = grid.pixels.long().unbind(1)
        known = views.information[n] > 0
        assert known.mean() > 0.8
        ratio = views.inverse_depth[n] * depth[y.numpy(), x.numpy()]
        assert np.median(np.abs(ratio[known] - 1)) < 0.01
    features = orb_features(image(pose(0.0), walls(0)))
    assert len(views.features[0]) == pytest.approx(len(features), rel=0.2)  # JPEG
    assert views.features[1].descriptors.shape == (len(views.features[1]), 32)
    assert views.outline().median_depth == pytest.approx(views.median_depth)
    assert views.outline().inverse_depth.nbytes < views.inverse_depth.nbytes / 100


def test_results_that_cannot_be_joined_are_refused(tmp_path):
    with pytest.raises(InputError, match="without the images"):
        opened(Part("x", make_result(tmp_path / "x", with_images=False)))
    with pytest.raises(InputError, match="holds no result"):
        opened(Part("x", tmp_path / "none"))


def views_with(*features: ImageFeatures) -> PartViews:
    n = len(features)
    ones = np.ones((n, 4), np.float32)
    return PartViews(np.tile(np.eye(4), (n, 1, 1)), np.arange(n) * 1.0, ones, ones, features)


def some_features(seed: int) -> ImageFeatures:
    random = np.random.default_rng(seed)
    descriptors = random.integers(0, 256, (80, 32), dtype=np.uint8)
    return ImageFeatures(random.uniform(0, 100, (80, 2)).astype(np.float32), descriptors)


def test_alike_keyframes_of_different_parts_are_found_and_those_beside_them_ruled_out():
    config = Config().loop
    looks = [some_features(seed) for seed in range(16)]
    first = views_with(*looks[:10])
    second = views_with(some_features(50), looks[2], looks[3], some_features(51), looks[9])
    third = views_with(looks[9], some_features(52))
    found = candidates([first, second, third], config)
    assert set(found) == {(0, 1), (0, 2), (1, 2)}
    assert found[0, 2] == [(9, 0)]
    assert found[1, 2] == [(4, 0)]
    assert (9, 4) in found[0, 1]
    near = [p for p in found[0, 1] if p != (9, 4)]
    assert near in ([(2, 1)], [(3, 2)])  # the two are too near to each other
    assert candidates([first], config) == {}
