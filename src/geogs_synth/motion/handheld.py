"""A hand-held camera path through a room."""

import math

import numpy as np
from jaxtyping import Float64, Real
from scipy.interpolate import BSpline, CubicSpline
from scipy.spatial.transform import Rotation

from geogs.errors import InputError
from geogs_synth.scene.textured_scene import Scene

FRAMES_PER_LAP = 280
"""Frames after which the camera is back near its first view."""

FRAMES_PER_SECOND = 30.0
"""Rate of the path and its hand shake."""

_KNOTS_PER_LAP = 9
_MIN_CLEARANCE = 0.6
_SHAKE_PERIOD = 7
_SHAKE_METRES = 0.004
_SHAKE_RADIANS = np.radians(0.3)


class HandheldPath:
    """A walk around the middle of a room, looking across it.

    Position and look-at point follow smooth periodic splines through random knots, plus a little
    hand shake that does not repeat; so the camera always moves sideways, never rotates in place,
    and after ``frames_per_lap`` frames (at 30 a second) comes back to within centimetres of its
    first view. It keeps 0.6 m from every surface.
    """

    def __init__(self, scene: Scene, seed: int = 0, frames_per_lap: int = FRAMES_PER_LAP) -> None:
        """Raises InputError if no such path keeps clear of the furniture."""
        self._seed = seed
        self._frames_per_lap = frames_per_lap
        self.position, self.target = _clear_splines(scene, seed, frames_per_lap)
        """Splines of the camera and of its look-at point over one lap in [0, 1], without shake."""

    def __call__(self, times: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 4 4"]:
        """Camera-to-world poses at times in seconds."""
        frames = FRAMES_PER_SECOND * times
        whole = np.rint(frames)
        # Rounding makes the time of a frame, in seconds, that frame exactly.
        return self.at_frames(np.where(np.abs(frames - whole) < 1e-9, whole, frames))

    def at_frames(self, frames: Real[np.ndarray, "n"]) -> Float64[np.ndarray, "n 4 4"]:
        """Camera-to-world poses at frame numbers, which need not be whole."""
        lap = frames / self._frames_per_lap
        T_wc = look_at(self.position(lap % 1.0), self.target(lap % 1.0))
        return with_shake(T_wc, self._seed, frames)


def _clear_splines(scene: Scene, seed: int, frames_per_lap: int) -> tuple[CubicSpline, CubicSpline]:
    """Position and look-at point of the widest path that keeps its distance."""
    whole = np.arange(4 * frames_per_lap) / (4 * frames_per_lap)
    for shrink in np.geomspace(1.0, 0.25, 16):
        position, target = _splines(scene, np.random.default_rng([seed, 0x7A1]), shrink)
        # The path of the whole lap decides, so that longer sequences begin with shorter ones.
        if scene.clearance(position(whole)).min() > _MIN_CLEARANCE + 5 * _SHAKE_METRES:
            return position, target
    raise InputError(f"no camera path keeps {_MIN_CLEARANCE} m from the furniture of this room")


def _splines(
    scene: Scene, rng: np.random.Generator, shrink: float
) -> tuple[CubicSpline, CubicSpline]:
    """Position and look-at point over one lap in [0, 1]."""
    middle = scene.size[:2] / 2
    reach = shrink * (middle - 1.1)
    full = rng.choice((-1.0, 1.0)) * 2 * np.pi
    angle = rng.uniform(0, 2 * np.pi) + full * np.arange(_KNOTS_PER_LAP) / _KNOTS_PER_LAP
    radius = rng.uniform(0.8, 1.1, _KNOTS_PER_LAP)
    height = rng.uniform(1.42, 1.62, _KNOTS_PER_LAP)
    outward = np.stack([np.cos(angle), np.sin(angle)], 1)
    position = np.column_stack([middle + radius[:, None] * outward * reach, height])
    across = middle - outward * rng.uniform(0.5, 0.9, (_KNOTS_PER_LAP, 1))
    target = np.column_stack([across, rng.uniform(0.85, 1.25, _KNOTS_PER_LAP)])
    s = np.linspace(0, 1, _KNOTS_PER_LAP + 1)

    def closed(knots: np.ndarray) -> CubicSpline:
        return CubicSpline(s, np.concatenate([knots, knots[:1]]), bc_type="periodic")

    return closed(position), closed(target)


def look_at(
    position: Float64[np.ndarray, "n 3"], target: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 4 4"]:
    """Camera to world with z towards the target and x level."""
    z = target - position
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (len(position), 1, 1))
    T[:, :3, :3] = np.stack([x, np.cross(z, x), z], -1)
    T[:, :3, 3] = position
    return T


def with_shake(
    T_wc: Float64[np.ndarray, "n 4 4"], seed: int, frames: Real[np.ndarray, "n"]
) -> Float64[np.ndarray, "n 4 4"]:
    """Add a smooth tremor: a cubic B-spline whose random coefficients act only locally.

    ``frames`` are the times of the poses in frames.
    """
    rng = np.random.default_rng([seed, 0x5A4])
    last = 1 + math.floor(frames.max(initial=0))
    count = last // _SHAKE_PERIOD + 4
    coefficients = np.clip(rng.standard_normal((count, 6)), -2.5, 2.5)
    knots = _SHAKE_PERIOD * np.arange(-3, count + 1)
    tremor = BSpline(knots, coefficients, 3)(frames)
    shaken = rotated(T_wc, _SHAKE_RADIANS * tremor[:, 3:])
    shaken[:, :3, 3] += _SHAKE_METRES * tremor[:, :3]
    return shaken


def rotated(
    T_wc: Float64[np.ndarray, "n 4 4"], angles: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 4 4"]:
    """Poses rotated in the camera's frame by rotation vectors."""
    found = T_wc.copy()
    found[:, :3, :3] = T_wc[:, :3, :3] @ Rotation.from_rotvec(angles).as_matrix()
    return found
