"""Meshes of solids, clearance, and the camera path through rooms of several seeds."""

import numpy as np
import pytest

from geogs.errors import InputError
from geogs_synth.motion.handheld import FRAMES_PER_LAP
from geogs_synth.raycast.raycaster import Raycaster
from geogs_synth.scene.builder import SceneBuilder, yaw_rotation
from geogs_synth.scene.textured_scene import Scene, scene_mesh
from geogs_synth.sequence.location import centred_camera
from geogs_synth.sequence.replica_files import SeenSurface
from handheld_walk import handheld_trajectory
from lit_rooms import lit_room


@pytest.fixture(scope="module", params=[0, 3])
def raycaster(request: pytest.FixtureRequest) -> Raycaster:
    return lit_room(request.param)


@pytest.fixture(scope="module")
def room(raycaster: Raycaster) -> Scene:
    return raycaster.scene


def _builder() -> tuple[SceneBuilder, int]:
    build = SceneBuilder(np.random.default_rng(0))
    return build, build.texture(np.zeros((4, 4, 3), np.uint8))


def _volume(scene: Scene) -> float:
    """Enclosed volume by the divergence theorem; positive if triangles face outwards."""
    vertices, triangles = scene_mesh(scene)
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def test_meshes_enclose_their_solids() -> None:
    turn = yaw_rotation(0.7)
    build, texture = _builder()
    build.at(1, 2, 3, 0.4).box((0.3, 0, 0), (0.5, 0.6, 0.7), texture, rotation=turn)
    assert _volume(build.build([4, 4, 4])) == pytest.approx(0.21, rel=1e-12)
    build, texture = _builder()
    build.frustum((1, 1, 1), (0.2, 0.4), 0.5, texture)
    cone = np.pi * 0.5 / 3 * (0.04 + 0.08 + 0.16)
    assert _volume(build.build([4, 4, 4])) == pytest.approx(cone, rel=5e-3)
    build, texture = _builder()
    build.ellipsoid((1, 1, 1), (0.2, 0.3, 0.1), texture, rotation=turn)
    ball = np.pi * 4 / 3 * 0.006
    assert _volume(build.build([4, 4, 4])) == pytest.approx(ball, rel=2e-2)


@pytest.mark.parametrize("radius", [0.03, 0.2, 0.5])
def test_round_meshes_are_within_a_millimetre(radius: float) -> None:
    """Centres of triangles are where chords are farthest from the surface."""
    build, texture = _builder()
    build.ellipsoid((0, 0, 0), (radius, radius, radius), texture)
    vertices, triangles = scene_mesh(build.build([1, 1, 1]))
    assert np.abs(np.linalg.norm(vertices, axis=1) - radius).max() < 1e-12
    middles = [vertices[triangles].mean(1)]
    middles += [(vertices[triangles[:, i]] + vertices[triangles[:, i - 1]]) / 2 for i in range(3)]
    depth = radius - np.linalg.norm(np.concatenate(middles), axis=1)
    assert 0 <= depth.max() < 1e-3


def test_rectangle_is_two_triangles_facing_along_z() -> None:
    build, texture = _builder()
    build.rectangle((1, 1, 0), (2, 1), texture, np.eye(3))
    vertices, triangles = scene_mesh(build.build([2, 2, 2]))
    assert triangles.shape == (2, 3)
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    np.testing.assert_allclose(np.cross(b - a, c - a), [[0, 0, 2], [0, 0, 2]])


def test_clearance_of_a_box() -> None:
    build, texture = _builder()
    build.at(1, 1, 1, np.pi / 2).box((0, 0, 0), (0.4, 0.2, 0.6), texture)
    scene = build.build([4, 4, 4])
    points = np.array([[1.5, 1, 1], [1, 1.5, 1], [1, 1, 1], [1.1 + 0.3, 1.2 + 0.4, 1.1]])
    np.testing.assert_allclose(scene.clearance(points), [0.4, 0.3, 0.0, 0.5], atol=1e-12)


def test_room_is_closed_and_of_the_right_size(raycaster: Raycaster, room: Scene) -> None:
    assert (room.size > [4, 3.5, 2.4]).all()
    assert (room.size < [5.2, 4.5, 2.9]).all()
    assert len(room) > 150
    view = raycaster.render(centred_camera(96, 72), handheld_trajectory(room, 1)[0])
    assert (view.solid >= 0).all()
    assert view.depth.min() > 0.4
    assert view.depth.max() < 7


def test_rooms_of_other_seeds_differ() -> None:
    first, other = (lit_room(seed).scene for seed in (0, 3))
    assert len(other) != len(first) or not np.allclose(other.solids.centre, first.solids.centre)
    assert not np.allclose(other.size, first.size)


def test_path_keeps_clear_of_everything(room: Scene) -> None:
    for seed in range(3):
        poses = handheld_trajectory(room, 2 * FRAMES_PER_LAP, seed)
        assert room.clearance(poses[:, :3, 3]).min() > 0.6


def test_path_is_smooth_and_moves_sideways(room: Scene) -> None:
    """No jumps, no standing still, no pure rotation, least of all at the start."""
    poses = handheld_trajectory(room, 300)
    step = np.diff(poses[:, :3, 3], axis=0)
    length = np.linalg.norm(step, axis=1)
    assert length.min() > 0.005
    assert length.max() < 0.06
    assert np.linalg.norm(np.diff(step, axis=0), axis=1).max() < 0.01
    relative = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
    angle = np.degrees(np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert angle.max() < 2.5
    start = poses[0, :3, :3].T @ (poses[8, :3, 3] - poses[0, :3, 3])
    assert abs(start[0]) > 0.08
    assert abs(start[0]) > 2 * abs(start[2])
    orthonormal = poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(orthonormal, np.tile(np.eye(3), (300, 1, 1)), atol=1e-12)


def test_path_comes_back(room: Scene) -> None:
    poses = handheld_trajectory(room, FRAMES_PER_LAP + 1)
    assert np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3]) < 0.03
    assert poses[0, :3, 2] @ poses[-1, :3, 2] > np.cos(np.radians(2))


def test_longer_paths_begin_with_shorter_ones(room: Scene) -> None:
    short, long = handheld_trajectory(room, 50), handheld_trajectory(room, 130)
    np.testing.assert_array_equal(short, long[:50])
    assert not np.allclose(short, handheld_trajectory(room, 50, seed=9))


def test_path_in_a_crowded_room_is_refused() -> None:
    build, texture = _builder()
    build.box((2, 2, 1.5), (2.5, 2.5, 0.5), texture)
    with pytest.raises(InputError, match="no camera path"):
        handheld_trajectory(build.build([4, 4, 2.6]), 10)


def test_seen_surface_keeps_one_exact_point_a_voxel() -> None:
    build, texture = _builder()
    build.rectangle((2, 2, 0), (4, 4), texture, np.eye(3))
    scene = build.build([4, 4, 3])
    camera = centred_camera(64, 48)
    T_wc = np.eye(4)
    T_wc[:3, :3] = np.diag([1.0, -1.0, -1.0])
    T_wc[:3, 3] = [2, 2, 1.0]
    seen = SeenSurface(scene, camera, voxel=0.05)
    for _ in range(2):
        seen.add(np.full((48, 64), 1.0, np.float32), T_wc)
    points = seen.points
    np.testing.assert_allclose(points[:, 2], 0, atol=1e-6)
    assert len(np.unique(np.floor(points / 0.05 + 1e-4), axis=0)) == len(points)
    area = 64 * 48 / camera.fx / camera.fy
    assert len(points) == pytest.approx(area / 0.05**2, rel=0.15)
