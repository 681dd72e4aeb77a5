"""The corridor of white panels, and tracking where hardly anything has texture."""

import cv2
import numpy as np
import pytest

from geogs.config import Config
from geogs.evaluation.trajectory_errors import evaluate_trajectory
from geogs.tracking.flow.cell_texture import cell_structure
from geogs.tracking.tracker import lone_tracker
from geogs.types import Frame, Trajectory
from geogs_synth.places.corridor import LENGTH, WALK_METRES, make_corridor, walk
from geogs_synth.raycast.raycaster import Raycaster, RenderedView
from geogs_synth.scene.textured_scene import Scene
from geogs_synth.sequence.location import centred_camera

CAMERA = centred_camera(208, 152)
SHORT = 10.0


@pytest.fixture(scope="module")
def corridor() -> Scene:
    return make_corridor(1, SHORT)


@pytest.fixture(scope="module")
def views(corridor: Scene) -> list[RenderedView]:
    raycaster, path = Raycaster(corridor, 1), walk(corridor, 1)
    times = np.arange(20) / path.rate
    return [raycaster.render(CAMERA, T_wc) for T_wc in path.path(times)]


def test_the_walk_stays_in_the_corridor_at_its_pace(corridor: Scene) -> None:
    """A longer corridor is no wider and has doors no thicker."""
    motion = walk(corridor, 1)
    centres = motion.path(np.arange(0, motion.seconds, 1 / motion.rate))[:, :3, 3]
    assert centres[:, 0].max() < LENGTH - 2
    assert np.ptp(centres[:, 0]) == pytest.approx(WALK_METRES, abs=0.2)
    folded = centres.copy()
    folded[:, 0] = 1 + centres[:, 0] % (SHORT - 2)
    assert corridor.clearance(folded).min() > 0.4
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert np.median(steps) == pytest.approx(0.078, abs=0.005)


def test_it_is_the_same_each_time_and_another_with_another_seed(corridor: Scene) -> None:
    again, other = make_corridor(1, SHORT), make_corridor(2, SHORT)
    assert (again.solids.centre == corridor.solids.centre).all()
    assert other.size[1] != corridor.size[1]


def test_hardly_anything_has_texture_in_two_directions(views: list[RenderedView]) -> None:
    grey = [cv2.cvtColor(v.image, cv2.COLOR_RGB2GRAY) for v in views]
    assert np.mean([cell_structure(image).textured_fraction for image in grey]) < 0.4
    assert min(float((v.depth > 0).mean()) for v in views) == 1.0


@pytest.mark.system
def test_all_of_it_is_tracked(corridor: Scene, views: list[RenderedView]) -> None:
    motion, tracker = walk(corridor, 1), lone_tracker(CAMERA, Config())
    times = np.arange(len(views)) / motion.rate
    for k, view in enumerate(views):
        tracker.track(Frame(k, float(times[k]), view.image))
    tracker.finish()
    found, known = tracker.trajectory(), np.ones(len(views), bool)
    assert found.tracked.all()
    errors = evaluate_trajectory(found, Trajectory(times, motion.path(times), known))
    assert errors.ate_rmse_cm < 0.01 * 100 * errors.path_length_m
