"""Rigid bodies that move through the view: people in rooms, vehicles on the street."""

import math

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import CubicSpline

from geogs.geometry.camera import Camera
from geogs_synth.places.street import LANE, LENGTH, START, driven, heading, on_road
from geogs_synth.places.vehicles import VAN_HEIGHT, VAN_LENGTH, VAN_WIDTH, car, draw_materials, van
from geogs_synth.scene.bodies import Body, Path, upright_poses
from geogs_synth.scene.builder import SceneBuilder
from geogs_synth.scene.textured_scene import Scene
from geogs_synth.textures import patterns

_HEIGHT = 1.72
_WIDTH = 0.42
"""Mean width of a figure over its height, metres."""
_PACE = 1.2
"""Walking speed past a camera that does not rotate, metres per second."""
_GROUPS = 3
_PAIR_FROM = 0.16
"""Coverage from which two walk side by side, so that they need not be too near."""
_BOB, _STEP_RATE = 0.02, 1.8
_KNOT_SECONDS = 0.5
"""Smoothing of the camera's viewing direction that walkers follow, seconds."""
_AWAY = -100.0
"""Height of figures that are not crossing: under the floor."""
_ONCOMING, _ONCOMING_SPEED = 3, 9.0
_GAP_WAVE, _GAP_PERIOD = 0.08, 7.0


def crossing_walkers(
    path: Path, seconds: float, camera: Camera, coverage: float, seed: int = 0
) -> list[Body]:
    """People who pass before a camera, one group after the other, from either side.

    While it passes, a group covers about the fraction ``coverage`` of the image: that sets its
    distance. They walk around the camera, so that a rotating camera sees them, too.

    Args:
        path: of the camera.
        seconds: duration for which they are needed.
        camera: its intrinsics.
        coverage: fraction of the image, above 0 and at most 1/2.
        seed: of their appearance.
    """
    rng = np.random.default_rng([seed, 0x9E0])
    times = np.arange(-2 * _KNOT_SECONDS, seconds + 3 * _KNOT_SECONDS, _KNOT_SECONDS)
    T_wc = path(times)
    yaw = np.unwrap(np.arctan2(T_wc[:, 1, 2], T_wc[:, 0, 2]))
    view = CubicSpline(times, np.column_stack([T_wc[:, :2, 3], yaw]))
    abreast = 2 if coverage > _PAIR_FROM else 1
    distance = _distance(T_wc, camera, coverage / abreast)
    half_view = math.atan(camera.width / 2 / camera.fx)
    reach = half_view + abreast * _WIDTH / distance
    period = 2 * reach * distance / _PACE
    return [
        Body(
            _figure(rng), _crossing(view, group, side * _WIDTH / distance, distance, reach, period)
        )
        for group in range(_GROUPS)
        for side in (np.arange(abreast) - (abreast - 1) / 2)
    ]


def _distance(T_wc: Float64[np.ndarray, "n 4 4"], camera: Camera, coverage: float) -> float:
    """Metres at which a figure on the floor covers a fraction of the image, by bisection."""
    eye = float(T_wc[:, 2, 3].mean())
    pitch = float(np.arcsin(T_wc[:, 2, 2]).mean())

    def covered(distance: float) -> float:
        ends = np.arctan2([_HEIGHT - eye, -eye], distance) - pitch
        rows = np.clip(camera.cy - camera.fy * np.tan(ends), 0, camera.height)
        width = min(camera.width, camera.fx * _WIDTH / distance)
        return float((rows[1] - rows[0]) * width / (camera.width * camera.height))

    near, far = 0.5, 30.0
    for _ in range(40):
        middle = math.sqrt(near * far)
        near, far = (middle, far) if covered(middle) > coverage else (near, middle)
    return near


def _crossing(
    view: CubicSpline, group: int, aside: float, distance: float, reach: float, period: float
) -> Path:
    """The path of one figure of a group; ``aside`` and ``reach`` in radians."""

    def path(times: np.ndarray) -> np.ndarray:
        turn = np.floor(times / period)
        part = times / period - turn
        x, y, yaw = view(times).T
        sense = np.where(turn % 2 == 0, 1.0, -1.0)
        bearing = yaw + sense * reach * (2 * part - 1) + aside
        cosine = np.cos(bearing)
        sine = np.sin(bearing)
        bob = _BOB * np.cos(2 * np.pi * _STEP_RATE * times)
        height = np.where(turn % _GROUPS == group, bob, _AWAY)
        position = np.column_stack([x + distance * cosine, y + distance * sine, height])
        # It faces in its walking direction.
        return upright_poses(position, sense * cosine, sense * sine)

    return path


def _figure(rng: np.random.Generator) -> Scene:
    """A person who stands on the origin and faces along y."""
    build = SceneBuilder(rng)

    def cloth() -> int:
        ground = patterns.random_colour(rng, (0.2, 0.8), (0.3, 0.9))
        stripe = patterns.random_colour(rng, (0.1, 0.6), (0.3, 0.95))
        return build.texture(patterns.fabric(rng, (256, 256), ground, stripe), 0.002)

    coat = cloth()
    trousers = cloth()
    tone = float(rng.uniform(0.55, 1.0))
    skin = build.texture(patterns.plaster(rng, (96, 192), (214 * tone, 168 * tone, 140 * tone)))
    hair = build.texture(patterns.plaster(rng, (96, 192), (70 * tone, 52 * tone, 40 * tone)))
    for side, forward in ((-1, 0.16), (1, -0.16)):
        build.frustum((0.1 * side, forward / 2, 0.0), (0.06, 0.1), 0.86, trousers)
        build.box((0.1 * side, forward / 2 + 0.05, 0.04), (0.1, 0.26, 0.08), hair)
        build.frustum((0.25 * side, -forward / 2, 0.82), (0.045, 0.065), 0.62, coat)
        build.ellipsoid((0.25 * side, -forward / 2, 0.78), (0.04, 0.05, 0.08), skin)
    build.frustum((0, 0, 0.8), (0.19, 0.23), 0.66, coat)
    build.frustum((0, 0, 1.44), (0.06, 0.055), 0.08, skin)
    build.ellipsoid((0, 0, 1.6), (0.09, 0.11, 0.12), skin)
    build.ellipsoid((0, -0.02, 1.64), (0.095, 0.11, 0.1), hair)
    return build.build((1.0, 1.0, 2.0))


def street_traffic(camera: Camera, coverage: float, seed: int = 0) -> list[Body]:
    """A van ahead that covers about the fraction ``coverage`` of the image, and oncoming cars."""
    rng = np.random.default_rng([seed, 0x7AF])
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
