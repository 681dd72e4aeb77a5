"""The dining room: what is thin in it, and that its path keeps clear."""

import numpy as np
import pytest

from geogs.evaluation.surfaces.raster import render_mesh
from geogs_bench.scoring.depth_scores import fit_planes, places_of
from geogs_synth.places.dining_room import make_dining_room
from geogs_synth.scene.textured_scene import scene_mesh
from geogs_synth.sequence.location import Location, make_location


@pytest.fixture(scope="module")
def location() -> Location:
    return make_location("dining", 0)


@pytest.mark.long
def test_it_is_the_same_each_time(location: Location) -> None:
    room, again = location.scene, make_dining_room(0)
    assert (room.solids.centre == again.solids.centre).all()
    assert (room.texture_shift == again.texture_shift).all()


def test_its_path_is_half_a_metre_from_everything(location: Location) -> None:
    centres = location.motion.path(np.arange(0, 280, 7) / 30)[:, :3, 3]
    assert location.scene.clearance(centres).min() > 0.5
    assert len(location.scene.solids.kind) < 400


def test_thin_things_and_what_is_behind_them_are_in_view(location: Location) -> None:
    camera, (vertices, faces, *_) = location.camera(200, 150), scene_mesh(location.scene)
    image = np.zeros((150, 200, 3), np.uint8)
    fractions = []
    for T_wc in location.motion.path(np.array([0.0, 3.0, 6.0])):
        depth, _ = render_mesh(vertices, faces, camera, np.linalg.inv(T_wc))
        places = places_of(depth, image, camera, fit_planes(depth, 7, 0.003))
        fractions.append([places["thin"].mean(), places["behind thin"].mean()])
    thin, behind = np.mean(fractions, 0)
    assert thin > 0.05
    assert behind > 0.15
