"""What a reconstruction reads of many posed images: the chosen ones, a few at a time."""

import weakref
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from geogs.application.posed_views import PosedViews
from geogs.config import ReconstructConfig
from geogs.evaluation.surfaces.surface import read_surface
from geogs.io.sources.posed.posed_source import PosedImage, PosedSource
from geogs.io.sources.sniff import open_posed_source
from geogs.mapping import first_look
from geogs.reconstruction import Reconstruction

RESIDENT = 4
CONFIG = ReconstructConfig(resident_keyframes=RESIDENT)


class Alive:
    """How many images that were read are in memory, and how many there were at most."""

    def __init__(self) -> None:
        self.read: list[int] = []
        self.now = self.most = 0

    def add(self, image: PosedImage) -> None:
        self.read.append(image.index)
        self.now += 1
        self.most = max(self.most, self.now)
        weakref.finalize(image.image, self._gone)

    def _gone(self) -> None:
        self.now -= 1


@pytest.fixture
def alive(monkeypatch) -> Alive:
    counted, read = Alive(), PosedSource.__getitem__

    def reading(source: PosedSource, index: int) -> PosedImage:
        image = read(source, index)
        counted.add(image)
        return image

    monkeypatch.setattr(PosedSource, "__getitem__", reading)
    return counted


def wall_points(source: PosedSource) -> np.ndarray:
    """Points two metres in front of every camera."""
    T_wc = np.linalg.inv(source.T_cw)
    return np.repeat(T_wc[:, :3, 3] + 2.0 * T_wc[:, :3, 2], 5, axis=0)


def test_chosen_images_are_read_one_by_one_and_few_stay_in_memory(small_room, alive):
    source = open_posed_source(small_room, CONFIG.input)
    scene = Reconstruction(source.camera, CONFIG)
    views = PosedViews(scene, source, lambda stage, fraction: None)
    views.choose(wall_points(source))
    assert alive.read == []
    views.give(10)
    views.give(30)
    assert len(alive.read) == len(set(alive.read)) == scene.views == 40
    assert scene.frames == len(source)
    # Those that stay with their keyframes, and that which is read while another is given.
    assert alive.most <= 2 * RESIDENT + 3
    times = scene.keyframe_trajectory().timestamps
    assert (np.diff(times) > 0).all()
    assert np.abs(scene.trajectory().T_wc - np.linalg.inv(source.T_cw)).max() < 1e-9


def test_no_more_than_the_most_views_are_given_and_all_of_few(small_room):
    few = replace(CONFIG, search=replace(CONFIG.search, most_views=7))
    for config, count in ((few, 7), (CONFIG, 12)):
        source = open_posed_source(small_room, replace(CONFIG.input, stride=5))
        scene = Reconstruction(source.camera, config)
        views = PosedViews(scene, source, lambda stage, fraction: None)
        views.choose(wall_points(source))
        views.give()
        assert scene.views == count


def test_a_few_images_see_less_of_the_scene_than_all(small_room):
    source = open_posed_source(small_room, CONFIG.input)
    scene = Reconstruction(source.camera, CONFIG)
    views = PosedViews(scene, source, lambda stage, fraction: None)
    views.choose(wall_points(source))
    near, all_views = views.times_the_surface([0, 1]), views.times_the_surface(range(len(source)))
    assert near > 1.2
    assert all_views == pytest.approx(1.0)


def test_the_first_look_reads_what_it_matches_and_finds_the_room(small_room, alive, monkeypatch):
    monkeypatch.setattr(first_look, "EDGE", 64)
    monkeypatch.setattr(first_look, "IMAGES", 4)
    source = open_posed_source(small_room, CONFIG.input)
    scene = Reconstruction(source.camera, CONFIG)
    points = PosedViews(scene, source, lambda stage, fraction: None).first_look()
    assert len(alive.read) == len(set(alive.read))
    assert alive.most <= 2
    truth = read_surface(small_room / "points_seen_1cm.ply").vertices
    distance = cKDTree(truth).query(points)[0]
    print(f"{len(points)} points, {100 * np.median(distance):.1f} cm from the room")
    assert len(points) > 500
    assert np.median(distance) < 0.1
