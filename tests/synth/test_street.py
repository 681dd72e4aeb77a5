"""The street and the drive along it: exactness, the sky, speed, what moves."""

from pathlib import Path

import numpy as np
import pytest
import torch

from geogs.errors import InputError
from geogs_synth.places.moving_bodies import street_traffic
from geogs_synth.places.street import DRIVE_METRES, drive, make_street
from geogs_synth.raycast.raycaster import Raycaster, RenderedView
from geogs_synth.scene.textured_scene import Scene, scene_mesh
from geogs_synth.sequence.location import STREET_FOCAL, centred_camera
from geogs_synth.sequence.replica_files import SeenSurface, write_sequence

CAMERA = centred_camera(124, 38, STREET_FOCAL)


@pytest.fixture(scope="module")
def street() -> Scene:
    """The beginning of one."""
    return make_street(0, 48.0)


@pytest.fixture(scope="module")
def raycaster(street: Scene) -> Raycaster:
    return Raycaster(street, 1)


@pytest.fixture(scope="module")
def view(raycaster: Raycaster) -> RenderedView:
    return raycaster.render(CAMERA, drive(0).path(np.zeros(1))[0])


def _tilted_up(degrees: float) -> np.ndarray:
    """Rotation in the camera's frame, about its x axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])


def test_sky_has_no_depth_and_the_ground_has(raycaster: Raycaster, view: RenderedView) -> None:
    assert (view.depth > 0).all()
    T_wc = drive(0).path(np.zeros(1))[0]
    T_wc[:3, :3] = T_wc[:3, :3] @ _tilted_up(30)
    raised = raycaster.render(CAMERA, T_wc)
    sky = raised.solid < 0
    assert 0.1 < sky.mean() < 0.95
    assert (raised.depth[sky] == 0).all()
    assert (raised.normal[sky] == 0).all()
    assert raised.image[sky].mean() > 140
    assert (raised.depth[~sky] > 0).all()


def test_sky_turns_with_the_camera_but_does_not_move(raycaster: Raycaster) -> None:
    T_wc = drive(0).path(np.zeros(1))[0]
    T_wc[2, 3] = 100.0
    T_wc[:3, :3] = T_wc[:3, :3] @ _tilted_up(50)
    up = raycaster.render(CAMERA, T_wc)
    assert (up.solid == -1).all()
    T_wc[:3, 3] += [3.0, 2.0, 0.0]
    moved = raycaster.render(CAMERA, T_wc)
    assert np.abs(up.image.astype(int) - moved.image).max() <= 3
    T_wc[:3, :3] = T_wc[:3, :3] @ _tilted_up(-20)
    assert np.abs(up.image.astype(int) - raycaster.render(CAMERA, T_wc).image).max() > 20


def test_depth_of_the_road_is_a_plane(view: RenderedView, street: Scene) -> None:
    """Road sections lie 3 cm above the ground, every other one 4 mm higher."""
    T_wc = drive(0).path(np.zeros(1))[0]
    rays = CAMERA.rays(torch.float64).numpy()
    height = (rays @ T_wc[:3, :3].T)[..., 2] * view.depth + T_wc[2, 3]
    road = np.isin(np.round(height[30:, 45:75], 4), [0.03, 0.034])
    assert road.mean() > 0.8


def test_drive_is_forward_in_its_lane(street: Scene) -> None:
    """At 6 to 14 m/s for 205 m, mostly along the optical axis, and clear of parked cars."""
    motion = drive(0)
    assert motion.rate == 10
    times = np.arange(0, motion.seconds, 0.1)
    T_wc = motion.path(times)
    step = np.diff(T_wc[:, :3, 3], axis=0)
    speed = 10 * np.linalg.norm(step, axis=1)
    assert speed.min() > 5
    assert speed.max() < 15
    length = np.linalg.norm(step, axis=1).sum()
    assert 0.97 * DRIVE_METRES < length < 1.02 * DRIVE_METRES
    along = (step / np.linalg.norm(step, axis=1, keepdims=True) * T_wc[:-1, :3, 2]).sum(1)
    assert along.min() > np.cos(np.radians(5))
    near = T_wc[:, 0, 3] < 46
    assert street.clearance(T_wc[near, :3, 3]).min() > 0.6
    turn = np.degrees(np.arctan2(T_wc[:, 1, 2], T_wc[:, 0, 2]))
    assert np.ptp(turn) > 10
    assert np.abs(np.diff(turn)).max() < 2


def test_traffic_covers_its_share(raycaster: Raycaster, street: Scene, view: RenderedView) -> None:
    T_wc = drive(0).path(np.zeros(1))[0]
    for fraction in (0.1, 0.3):
        busy = raycaster.with_bodies(street_traffic(CAMERA, fraction))
        seen = busy.render(CAMERA, T_wc)
        moving = seen.solid >= len(street)
        assert moving.mean() == pytest.approx(fraction, rel=0.35)
        far = np.where(view.depth > 0, view.depth, np.inf)
        assert (seen.depth[moving] < far[moving]).all()
        np.testing.assert_array_equal(seen.depth[~moving], view.depth[~moving])


def test_the_sky_is_no_surface(street: Scene, view: RenderedView) -> None:
    vertices, _ = scene_mesh(street)
    assert np.abs(vertices).max() < 1000
    assert street.clearance(np.array([[24.0, 23.0, 17.0]])).min() > 1.0
    seen = SeenSurface(street, CAMERA, 0.1)
    seen.add(view.depth, drive(0).path(np.zeros(1))[0])
    assert (seen.points > -0.11).all()
    assert (seen.points < street.size + 0.21).all()
    assert len(seen.points) > 500


def test_the_drive_ends(tmp_path: Path, raycaster: Raycaster) -> None:
    with pytest.raises(InputError, match="driving ends after 1"):
        write_sequence(tmp_path, 300, motion="driving", raycaster=raycaster)
    write_sequence(tmp_path, 2, 62, 19, motion="driving", raycaster=raycaster)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"rgb.txt", "groundtruth.txt", "points_seen_10cm.ply"} <= names
