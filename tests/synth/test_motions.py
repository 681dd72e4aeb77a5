"""What each motion is said to be, measured on its poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs_synth.motion.motion_kinds import ROOM_MOTIONS, MotionKind
from geogs_synth.motion.room_motions import room_motion
from geogs_synth.scene.textured_scene import Scene
from handheld_walk import handheld_trajectory
from lit_rooms import lit_room


@pytest.fixture(scope="module")
def room() -> Scene:
    return lit_room(3).scene


TIMES = np.arange(0, 10, 1 / 60)


def _speeds(T_wc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Metres and degrees per second between poses at TIMES."""
    relative = T_wc[:-1, :3, :3].transpose(0, 2, 1) @ T_wc[1:, :3, :3]
    angle = Rotation.from_matrix(relative).magnitude()
    step = np.linalg.norm(np.diff(T_wc[:, :3, 3], axis=0), axis=1)
    return 60 * step, 60 * np.degrees(angle)


@pytest.mark.parametrize("kind", ROOM_MOTIONS)
def test_every_motion_is_rigid_smooth_and_clear(kind: MotionKind, room: Scene) -> None:
    path = room_motion(kind, room, 1).path
    T_wc = path(TIMES)
    rotation = T_wc[:, :3, :3]
    unit = rotation @ rotation.transpose(0, 2, 1)
    np.testing.assert_allclose(unit, np.tile(np.eye(3), (len(TIMES), 1, 1)), atol=1e-9)
    assert room.clearance(T_wc[::12, :3, 3]).min() > 0.5
    metres, degrees = _speeds(T_wc)
    assert metres.max() < 1.2
    assert degrees.max() < 200
    # Rows before the first frame and between frames fit to their neighbours.
    near = path(TIMES[:5, None].repeat(2, 1).ravel() + np.tile([-1e-4, 1e-4], 5))
    assert np.abs(near[::2, :3, 3] - near[1::2, :3, 3]).max() < 1e-3
    np.testing.assert_array_equal(path(TIMES[30:33]), T_wc[30:33])


def test_handheld_is_the_path_at_whole_frames(room: Scene) -> None:
    poses = room_motion("handheld", room, 2).path(np.arange(200) / 30)
    np.testing.assert_array_equal(poses, handheld_trajectory(room, 200, 2))


@pytest.mark.parametrize("rate", [30, 60, 120])
def test_turning_is_as_fast_as_it_says(rate: int, room: Scene) -> None:
    T_wc = room_motion(f"turning-{rate}", room).path(TIMES)
    yaw = np.unwrap(np.arctan2(T_wc[:, 1, 2], T_wc[:, 0, 2]))
    mean = np.degrees(abs(yaw[-1] - yaw[0])) / (TIMES[-1] - TIMES[0])
    assert mean == pytest.approx(rate, rel=0.01)
    metres, degrees = _speeds(T_wc)
    assert np.median(degrees) == pytest.approx(rate, rel=0.05)
    spread = np.sqrt(((T_wc[:, :3, 3] - T_wc[:, :3, 3].mean(0)) ** 2).sum(1).mean())
    assert 0.15 < spread < 0.4
    assert metres.max() < 0.8


def test_pure_rotation_does_not_move(room: Scene) -> None:
    T_wc = room_motion("pure-rotation", room).path(TIMES)
    assert (T_wc[:, :3, 3] == T_wc[0, :3, 3]).all()
    _, degrees = _speeds(T_wc)
    assert 10 < np.median(degrees) < 40
    assert degrees.max() < 90


def test_slow_walks_rests_jerks_and_stands(room: Scene) -> None:
    paths = {kind: room_motion(kind, room).path for kind in ROOM_MOTIONS}
    speeds = {kind: _speeds(path(TIMES)) for kind, path in paths.items()}
    handheld, slow = (np.median(speeds[kind][0]) for kind in ("handheld", "slow-handheld"))
    assert 3 < handheld / slow < 5
    assert (paths["still"](TIMES) == paths["still"](TIMES[:1])).all()
    metres, degrees = speeds["rest-start"]
    resting = TIMES[1:] <= 1.5
    assert metres[resting].max() == degrees[resting].max() == 0
    assert np.median(metres[TIMES[1:] > 2.6]) > 0.4
    assert np.abs(np.diff(metres)).max() < 0.1
    assert speeds["jerks"][1].max() > 60
    assert np.median(speeds["jerks"][1]) < 20


def test_steps_are_two_a_second(room: Scene) -> None:
    height = room_motion("walking", room).path(TIMES)[:, 2, 3]
    spectrum = np.abs(np.fft.rfft((height - height.mean()) * np.hanning(len(height))))
    frequency = np.fft.rfftfreq(len(height), 1 / 60)
    fast = frequency > 1.0
    assert frequency[fast][spectrum[fast].argmax()] == pytest.approx(2, abs=0.2)


def test_rates(room: Scene) -> None:
    for kind in ROOM_MOTIONS:
        assert room_motion(kind, room).rate == (5 if kind == "handheld-5hz" else 30)
