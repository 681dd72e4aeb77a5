"""Vehicles that move on the street: a van ahead and oncoming cars."""

import math

import numpy as np

from geogs.geometry.camera import Camera
from geogs_synth.places.street import LANE, LENGTH, START, driven, heading, on_road
from geogs_synth.places.vehicles import VAN_HEIGHT, VAN_LENGTH, VAN_WIDTH, car, draw_materials, van
from geogs_synth.scene.bodies import Body, Path, upright_poses
from geogs_synth.scene.builder import SceneBuilder
from geogs_synth.scene.textured_scene import Scene

_ONCOMING, _ONCOMING_SPEED = 3, 9.0
_GAP_WAVE, _GAP_PERIOD = 0.08, 7.0
_STREAM = 0x7AF


def street_traffic(camera: Camera, coverage: float, seed: int = 0) -> list[Body]:
    """A van ahead that covers about the fraction ``coverage`` of the image, and oncoming cars."""
    rng = np.random.default_rng([seed, _STREAM])
    covered = camera.fx * camera.fy * VAN_WIDTH * VAN_HEIGHT / (camera.width * camera.height)
    gap = math.sqrt(covered / coverage) + VAN_LENGTH / 2
    ahead = SceneBuilder(rng)
    van(ahead, rng, draw_materials(ahead, rng, 2))
    bodies = [Body(_shape(ahead), _follows(gap, seed))]
    for k in range(_ONCOMING):
        build = SceneBuilder(rng)
        car(build, rng, draw_materials(build, rng, 2))
        bodies.append(Body(_shape(build), _comes(k / _ONCOMING)))
    return bodies


def _shape(build: SceneBuilder) -> Scene:
    return build.build((VAN_LENGTH, VAN_WIDTH, VAN_HEIGHT))


def _follows(gap: float, seed: int) -> Path:
    """Path of the van: ahead of the camera in its lane, at a distance that varies a little."""

    def path(times: np.ndarray) -> np.ndarray:
        away = gap * (1 + _GAP_WAVE * np.sin(2 * np.pi * times / _GAP_PERIOD))
        x = START + driven(times, seed) + away
        return _placed(x, LANE, 0.0)

    return path


def _comes(part: float) -> Path:
    """Path of an oncoming car, again and again, ``part`` of the street ahead of the first."""

    def path(times: np.ndarray) -> np.ndarray:
        return _placed((part * LENGTH - _ONCOMING_SPEED * times) % LENGTH, -LANE, np.pi)

    return path


def _placed(x: np.ndarray, left: float, offset: float) -> np.ndarray:
    """Body to world on the road, heading along it but for an ``offset`` in radians."""
    yaw = heading(x) + offset
    position = np.column_stack([on_road(x, np.full(len(x), left)), np.full(len(x), 0.03)])
    return upright_poses(position, np.cos(yaw), np.sin(yaw))
