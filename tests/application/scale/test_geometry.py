"""The scale by distances and by the camera's height, in a room of planes of another unit."""

import numpy as np
import pytest
import torch

from geogs.application.scale.known_length import (
    CameraHeight,
    KnownDistance,
    KnownDistances,
    ground_plane,
    scale_by_distances,
    scale_by_height,
)
from geogs.application.scale.measurable_scene import MeasurableScene, SeenKeyframe
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.types import Trajectory

CAMERA = Camera(fx=180.0, fy=180.0, cx=159.5, cy=119.5, width=320, height=240)
DEPTH = CAMERA.resized(160, 120)
UNIT = 0.4
HEIGHT = 1.5
"""Of the camera over the floor, metres; a table of 0.7 m stands in the room."""


def tilted(x: float, height: float, pitch: float) -> np.ndarray:
    """World (y down, floor at y = 0) to camera of one that looks along z, and down by pitch."""
    c, s = np.cos(pitch), np.sin(pitch)
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, c, -s], [0, s, c]]
    T[:3, 3] = -T[:3, :3] @ [x, -height, 0.0]
    return T


def depth_of(T_cw: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """Floor, table and a wall at z = 4 m, in metres; z along the axis."""
    R, centre = T_cw[:3, :3], -T_cw[:3, :3].T @ T_cw[:3, 3]
    rays = DEPTH.rays(torch.float64).numpy() @ R
    depth = (4.0 - centre[2]) / rays[..., 2]
    for level, inside in ((0.0, (-9, 9)), (-0.7, (0.2, 1.4))):
        with np.errstate(divide="ignore"):
            z = (level - centre[1]) / rays[..., 1]
        x = centre[0] + z * rays[..., 0]
        deep = centre[2] + z * rays[..., 2]
        hit = (z > 0) & (z < depth) & (x > inside[0]) & (x < inside[1])
        depth = np.where(hit & ((level == 0) | (deep < 3)), z, depth)
    rng = np.random.default_rng(int(1e3 * abs(centre[0])))
    return depth * (1 + noise * rng.standard_normal(depth.shape))


def scene(count: int = 9, noise: float = 0.0) -> MeasurableScene:
    metric = [tilted(0.2 * k - 0.8, HEIGHT + 0.02 * np.sin(k), 0.5) for k in range(count)]

    def in_units(T: np.ndarray) -> np.ndarray:
        T = T.copy()
        T[:3, 3] *= UNIT
        return T

    def surface(T: np.ndarray) -> np.ndarray:
        T = T.copy()
        T[:3, 3] /= UNIT
        return UNIT * depth_of(T, noise)

    poses = [in_units(T) for T in metric]
    trajectory = Trajectory(
        np.arange(count) / 30, np.linalg.inv(np.stack(poses)), np.ones(count, bool)
    )
    return MeasurableScene(
        CAMERA, DEPTH, [SeenKeyframe(T, None) for T in poses], trajectory, surface
    )


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_the_ground_is_the_plane_below_all_not_the_table(noise):
    found = scale_by_height(scene(noise=noise), CameraHeight(HEIGHT))
    assert found.factor * UNIT == pytest.approx(1, abs=0.01)
    assert 0.005 <= found.deviation < 0.03


def test_no_ground_is_told():
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-1, 1, (3000, 3))
    centres = np.zeros((4, 3))
    assert ground_plane(cloud, centres, np.array([0.0, -1, 0]), rng) is None
    assert ground_plane(cloud[:2], centres, np.array([0.0, -1, 0]), rng) is None


def pixel_of(T_cw: np.ndarray, X: np.ndarray, calibration: Calibration) -> tuple[float, float]:
    from lenses import distorted_pixels

    seen = T_cw[:3, :3] @ X + T_cw[:3, 3]
    rays = (seen[:2] / seen[2])[None]
    u, v = distorted_pixels(rays, calibration.camera(), calibration.distortion)[0]
    return float(u), float(v)


@pytest.mark.parametrize(("noise", "bound"), [(0.0, 0.001), (0.01, 0.01)])
def test_a_distance_between_two_pixels_tells_the_scale(noise, bound):
    lens = Calibration(360.0, 360.0, 319.5, 239.5, (0.05, -0.1, 0.0, 0.0), 640, 480)
    T = tilted(0.2 * 4 - 0.8, HEIGHT + 0.02 * np.sin(4), 0.5)
    a, b = np.array([-0.6, 0.0, 2.2]), np.array([0.15, 0.0, 3.2])
    pixels = pixel_of(T, a, lens), pixel_of(T, b, lens)
    length = float(np.linalg.norm(a - b))
    known = KnownDistances((KnownDistance(4, *pixels, length),))
    found = scale_by_distances(scene(noise=noise), known, lens)
    assert found.factor * UNIT == pytest.approx(1, abs=bound)
    assert 0.001 < found.deviation < 0.03
    twice = KnownDistances((known.each[0], KnownDistance(4, *pixels, 1.1 * length)))
    both = scale_by_distances(scene(noise=noise), twice, lens)
    assert both.origin == "2 known distances"
    assert both.deviation > 2 * found.deviation  # they disagree by 10 %


def test_pixels_that_cannot_be_lifted_are_told():
    lens = Calibration(180.0, 180.0, 159.5, 119.5, (), 320, 240)
    for frame, second, why in ((99, (60.0, 60.0), "has no place"), (0, (900.0, 60.0), "outside")):
        known = KnownDistances((KnownDistance(frame, (50.0, 200.0), second, 1.0),))
        with pytest.raises(InputError, match=why):
            scale_by_distances(scene(), known, lens)
    blind = scene()
    blind = MeasurableScene(
        CAMERA, DEPTH, blind.keyframes, blind.trajectory, lambda T: np.zeros((120, 160))
    )
    known = KnownDistances((KnownDistance(0, (50.0, 200.0), (60.0, 60.0), 1.0),))
    with pytest.raises(InputError, match="has no depth at a pixel"):
        scale_by_distances(blind, known, lens)
