"""Motions of a camera through a room, each a pose for any time.

The first frame is at time 0. All keep clear of the furniture.
"""

import math
from dataclasses import dataclass

import numpy as np

from geogs_synth.motion.handheld import (
    FRAMES_PER_LAP,
    FRAMES_PER_SECOND,
    HandheldPath,
    look_at,
    rotated,
    with_shake,
)
from geogs_synth.motion.motion_kinds import RoomMotionKind
from geogs_synth.scene.bodies import Path
from geogs_synth.scene.textured_scene import Scene

_SLOW = 4
"""Duration of the slow path over that of the usual one."""
_ARM = 0.25
"""Distance from the axis about which a person turns to the camera, metres."""
_EYE_HEIGHT = 1.5
_WALK_LAP = 1.7
"""Laps of the hand-held path that one lap of the walk takes."""
_STEP_RATE = 2.0
"""Steps a second; the body sways to either side once in two steps."""
_BOB, _SWAY = 0.025, 0.02
"""Amplitudes up and down, and sideways, metres."""
_GAIT_DEGREES = 0.8
_REST, _GETTING_GOING = 1.5, 1.0
"""Seconds of rest at the start, and from there to full speed."""
_GOING, _STOPPING = 1.3, 0.4
"""Seconds of walking before the camera stops to turn, and to stop or to walk again."""
_AWAY_DEGREES, _AWAY, _AWAY_HOLD = 120.0, 1.6, 0.2
"""Rotation away in degrees, its seconds either way, and those between."""
_JERK_PERIOD, _JERK_HALF_LENGTH = 0.9, 0.12
_TURN_STREAM = 0x704


@dataclass(frozen=True)
class Motion:
    """Pose of the camera at any time, and its frame rate."""

    path: Path
    """Camera to world at times in seconds."""
    rate: float = FRAMES_PER_SECOND
    """Frames per second."""
    seconds: float = math.inf
    """Duration."""


def room_motion(kind: RoomMotionKind, scene: Scene, seed: int = 0) -> Motion:
    """A motion through a room; the same seed gives the same path.

    Raises:
        InputError: the room has no space for it.
    """
    match kind:
        case "handheld" | "handheld-5hz":
            rate = 5.0 if kind == "handheld-5hz" else FRAMES_PER_SECOND
            return Motion(HandheldPath(scene, seed), rate)
        case "slow-handheld":
            return Motion(_slow(scene, seed))
        case "walking":
            return Motion(_walking(scene, seed))
        case "turning-30" | "turning-60" | "turning-120":
            return Motion(_turning(scene, seed, float(kind.removeprefix("turning-"))))
        case "pure-rotation":
            return Motion(_pure_rotation(scene, seed))
        case "turn-away":
            return Motion(_turn_away(HandheldPath(scene, seed), seed))
        case "rest-start":
            return Motion(_from_rest(HandheldPath(scene, seed)))
        case "jerks":
            return Motion(_with_jerks(_slow(scene, seed), seed))
        case "still":
            return Motion(_still(scene, seed))


def _slow(scene: Scene, seed: int) -> HandheldPath:
    return HandheldPath(scene, seed, _SLOW * FRAMES_PER_LAP)


def _walking(scene: Scene, seed: int) -> Path:
    """A walk around the room, looking ahead and inwards, with the bob and sway of steps."""
    handheld = HandheldPath(scene, seed)
    seconds_per_lap = _WALK_LAP * FRAMES_PER_LAP / FRAMES_PER_SECOND
    ahead = handheld.position.derivative()

    def path(times: np.ndarray) -> np.ndarray:
        lap = times / seconds_per_lap % 1.0
        position = handheld.position(lap)
        inwards = handheld.target(lap) - handheld.position(lap)
        along = ahead(lap)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        inwards /= np.linalg.norm(inwards, axis=1, keepdims=True)
        T_wc = look_at(position, position + along + 0.6 * inwards)
        step = 2 * np.pi * _STEP_RATE * times
        stride = np.pi * _STEP_RATE * times
        T_wc[:, :3, 3] += _SWAY * np.sin(stride)[:, None] * T_wc[:, :3, 0]
        T_wc[:, 2, 3] += _BOB * np.cos(step)
        nod = np.stack([np.sin(step), np.cos(stride), np.sin(stride)], 1)
        return rotated(T_wc, np.radians(_GAIT_DEGREES) * nod)

    return path


def _turning(scene: Scene, seed: int, degrees_per_second: float) -> Path:
    """A turn on the spot: the camera at arm's length circles the body, which wanders a little."""
    rng = np.random.default_rng([seed, _TURN_STREAM])
    start, sense, phases = rng.uniform(0, 2 * np.pi), rng.choice((-1.0, 1.0)), rng.uniform(0, 6, 3)
    middle = scene.size[:2] / 2

    def path(times: np.ndarray) -> np.ndarray:
        yaw = start + sense * np.radians(degrees_per_second) * times
        pitch = np.radians(-8 + 5 * np.sin(0.9 * times + phases[0]))
        axis = middle + 0.06 * np.stack([np.sin(times + phases[1]), np.cos(times + phases[1])], 1)
        height = _EYE_HEIGHT + 0.03 * np.sin(1.3 * times + phases[2])
        outward = np.stack([np.cos(yaw), np.sin(yaw)], 1)
        position = np.column_stack([axis + _ARM * outward, height])
        ahead = np.column_stack([np.cos(pitch)[:, None] * outward, np.sin(pitch)])
        T_wc = look_at(position, position + ahead)
        return with_shake(T_wc, seed, FRAMES_PER_SECOND * times)

    return path


def _pure_rotation(scene: Scene, seed: int) -> Path:
    """Pure rotation on a tripod: the camera's centre does not move at all."""
    phases = np.random.default_rng([seed, _TURN_STREAM]).uniform(0, 2 * np.pi, 4)
    position = np.array([*(scene.size[:2] / 2), _EYE_HEIGHT])

    def path(times: np.ndarray) -> np.ndarray:
        wide = np.sin(2 * np.pi * times / 6 + phases[0])
        quick = np.sin(2 * np.pi * times / 2.3 + phases[1])
        yaw = phases[3] + np.radians(35 * wide + 8 * quick)
        pitch = np.radians(-8 + 8 * np.sin(2 * np.pi * times / 3.1 + phases[2]))
        ahead = np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
        centre = np.repeat(position[None], len(times), 0)
        T_wc = look_at(centre, centre + ahead.T)
        T_wc[:, :3, 3] = position
        roll = np.radians(2 * np.sin(2 * np.pi * times / 4.7))
        return rotated(T_wc, np.stack([0 * roll, 0 * roll, roll], 1))

    return path


def _turn_away(path: Path, seed: int) -> Path:
    """Walk, stop, turn on the spot to an unseen part of the room, turn back, and walk on."""
    sense = np.random.default_rng([seed, _TURN_STREAM]).choice((-1.0, 1.0))
    standing = 2 * _AWAY + _AWAY_HOLD

    def turned_away(times: np.ndarray) -> np.ndarray:
        stop = np.clip(times - _GOING, 0, _STOPPING)
        go = np.clip(times - (_GOING + _STOPPING + standing), 0, None)
        walked = np.minimum(times, _GOING) + stop - 0.5 * stop**2 / _STOPPING
        walked = walked + _speeding_up(go, _STOPPING)
        turn = times - (_GOING + _STOPPING)
        there, back = (np.clip(t / _AWAY, 0, 1) for t in (turn, turn - _AWAY - _AWAY_HOLD))
        yaw = np.radians(_AWAY_DEGREES) * 0.5 * (np.cos(np.pi * back) - np.cos(np.pi * there))
        return rotated(path(walked), np.stack([0 * yaw, sense * yaw, 0 * yaw], 1))

    return turned_away


def _from_rest(path: Path) -> Path:
    """Stand perfectly still at first, then start to move."""

    def rested(times: np.ndarray) -> np.ndarray:
        return path(_speeding_up(np.clip(times - _REST, 0, None), _GETTING_GOING))

    return rested


def _with_jerks(path: Path, seed: int) -> Path:
    """Knock the camera by some degrees and centimetres every second or so; it comes back."""

    def jerky(times: np.ndarray) -> np.ndarray:
        T_wc = path(times).copy()
        knock = np.zeros((len(times), 6))
        for k in range(max(0, int(times.max(initial=0) / _JERK_PERIOD) + 2)):
            rng = np.random.default_rng([seed, 0x3E6, k])
            middle = (k + 1 + rng.uniform(-0.3, 0.3)) * _JERK_PERIOD
            size = rng.choice((-1.0, 1.0), 6) * rng.uniform(0.5, 1.0, 6)
            size *= np.array([*np.radians([6.0, 10.0, 3.0]), 0.04, 0.03, 0.02])
            near = np.clip((times - middle) / _JERK_HALF_LENGTH, -1, 1)
            knock += 0.5 * (1 + np.cos(np.pi * near))[:, None] * size
        T_wc[:, :3, 3] += np.einsum("nij,nj->ni", T_wc[:, :3, :3], knock[:, 3:])
        return rotated(T_wc, knock[:, :3])

    return jerky


def _still(scene: Scene, seed: int) -> Path:
    """A camera at rest on a tripod."""
    T_wc = HandheldPath(scene, seed).at_frames(np.zeros(1))

    return lambda times: np.repeat(T_wc, len(times), 0)


def _speeding_up(seconds: np.ndarray, ramp: float) -> np.ndarray:
    """Seconds of the full speed that lead as far as a start from rest, full after ``ramp``."""
    return np.where(seconds < ramp, 0.5 * seconds**2 / ramp, seconds - 0.5 * ramp)
