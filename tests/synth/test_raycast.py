"""The raycaster against analytic surfaces, triangles, and itself from another view."""

import math

import cv2
import numpy as np
import pytest
import torch

from geogs.geometry.camera import Camera
from geogs.geometry.depth_maps import normals_from_depth
from geogs_synth.places.room import make_room
from geogs_synth.raycast.raycaster import Raycaster, RenderedView
from geogs_synth.raycast.solid_kernels import BoundedSolids, crossing, visibility_slices
from geogs_synth.scene.builder import SceneBuilder, yaw_rotation
from geogs_synth.scene.textured_scene import Scene, scene_mesh
from geogs_synth.sequence.location import centred_camera
from handheld_walk import handheld_trajectory
from lit_rooms import lit_room

CAMERA = Camera(70.0, 72.0, 40.3, 29.1, 80, 60)


@pytest.fixture(scope="module")
def raycaster() -> Raycaster:
    return lit_room(0)


@pytest.fixture(scope="module")
def room(raycaster: Raycaster) -> Scene:
    return raycaster.scene


@pytest.fixture(scope="module")
def poses(room: Scene) -> np.ndarray:
    return handheld_trajectory(room, 60)


def _builder() -> tuple[SceneBuilder, int]:
    build = SceneBuilder(np.random.default_rng(0))
    build.light((2.0, 2.0, 2.0), (1.0, 1.0, 1.0), 0.1)
    return build, build.texture(np.full((8, 8, 3), 128, np.uint8), 0.01)


def _pose(position: list[float], yaw: float = 0.0) -> np.ndarray:
    """Looks along world +y when yaw is zero, x to the right, level."""
    T_wc = np.eye(4)
    T_wc[:3, :3] = yaw_rotation(yaw) @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    T_wc[:3, 3] = position
    return T_wc


def _rays() -> np.ndarray:
    return CAMERA.rays(torch.float64).numpy()


def test_wall_is_exact() -> None:
    """An oblique wall: depth solves n . (o + z ray) = d at every integer pixel centre."""
    build, texture = _builder()
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    build.rectangle((2.0, 4.0, 1.5), (30.0, 30.0), texture, upright)
    T_wc = _pose([2.0, 1.0, 1.2], yaw=0.35)
    view = Raycaster(build.build([4.0, 4.0, 3.0])).render(CAMERA, T_wc)
    normal = T_wc[:3, :3].T @ np.array([0.0, -1.0, 0.0])
    expected = -3.0 / (_rays() @ normal)
    np.testing.assert_allclose(view.depth, expected, rtol=1e-6)
    np.testing.assert_allclose(view.normal, np.broadcast_to(normal, (60, 80, 3)), atol=1e-6)
    assert (view.solid == 0).all()


def test_ball_and_cylinder_are_exact() -> None:
    """Against the quadratics of a ball and of an upright cylinder, in the camera frame."""
    build, texture = _builder()
    build.ellipsoid((1.5, 3.0, 1.5), (0.4, 0.4, 0.4), texture)
    build.frustum((2.6, 3.0, 0.5), (0.3, 0.3), 2.5, texture)
    T_wc = _pose([2.0, 1.0, 1.5])
    view = Raycaster(build.build([4.0, 4.0, 3.0])).render(CAMERA, T_wc)
    rays = _rays()

    def nearest(ray: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
        a, b, c = (ray**2).sum(-1), ray @ centre, centre @ centre - radius**2
        return (b - np.sqrt(b * b - a * c)) / a

    for solid, ray, centre, radius in (
        (0, rays, np.array([-0.5, 0.0, 2.0]), 0.4),
        (1, rays[..., [0, 2]], np.array([0.6, 2.0]), 0.3),
    ):
        seen = view.solid == solid
        assert seen.sum() > 200
        expected = nearest(ray[seen], centre, radius)
        np.testing.assert_allclose(view.depth[seen], expected, rtol=1e-6)
        normal = (ray[seen] * expected[:, None] - centre) / radius
        found = view.normal[seen] if solid == 0 else view.normal[seen][:, [0, 2]]
        np.testing.assert_allclose(found, normal, atol=1e-5)


def test_nothing_hit_is_zero() -> None:
    build, texture = _builder()
    build.box((2.0, 3.0, 1.5), (0.2, 0.2, 0.2), texture)
    view = Raycaster(build.build([4.0, 4.0, 3.0])).render(CAMERA, _pose([2.0, 1.0, 1.5]))
    missed = view.solid < 0
    assert 0.8 < missed.mean() < 1.0
    assert (view.depth[missed] == 0).all()
    assert (view.normal[missed] == 0).all()
    assert (view.depth[~missed] == np.float32(1.9)).all()


def _triangle_depths(scene: Scene, rays: np.ndarray, T_wc: np.ndarray) -> np.ndarray:
    """Nearest depth of each ray over all triangles (Moeller and Trumbore 1997)."""
    vertices, triangles = scene_mesh(scene)
    corner = ((vertices - T_wc[:3, 3]) @ T_wc[:3, :3])[triangles]
    e1, e2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    from_corner = -corner[:, 0]
    q = np.cross(from_corner, e1)
    depths = []
    for ray in rays:
        p = np.cross(ray, e2)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / (e1 * p).sum(1)
            u, v = (from_corner * p).sum(1) * inverse, (q @ ray) * inverse
            t = (e2 * q).sum(1) * inverse
        hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 1e-6)
        depths.append(t[hit].min())
    return np.array(depths)


def test_depth_equals_the_mesh(room: Scene, raycaster: Raycaster, poses: np.ndarray) -> None:
    """Boxes agree to rounding, round solids to the millimetre, up to a few silhouettes."""
    rng = np.random.default_rng(1)
    errors, is_box = [], []
    for T_wc in poses[::20]:
        view = raycaster.render(CAMERA, T_wc)
        row, column = rng.integers(0, 60, 120), rng.integers(0, 80, 120)
        expected = _triangle_depths(room, _rays()[row, column], T_wc)
        errors.append(np.abs(view.depth[row, column] - expected))
        is_box.append(room.solids.kind[view.solid[row, column]] == 0)
    error, box = np.concatenate(errors), np.concatenate(is_box)
    assert np.quantile(error[box], 0.99) < 1e-5
    assert np.quantile(error, 0.99) < 2e-3


def test_normals_agree_with_depth(raycaster: Raycaster, poses: np.ndarray) -> None:
    """Facing the camera, and equal to those of the depth map inside flat faces."""
    camera = centred_camera(160, 120)
    view = raycaster.render(camera, poses[10])
    normal = torch.from_numpy(view.normal)
    assert ((normal * camera.rays()).sum(-1) < 0).all()
    numeric, valid = normals_from_depth(torch.from_numpy(view.depth), camera)
    angle = torch.acos((numeric * normal).sum(-1).clamp(-1, 1))[valid].rad2deg()
    assert angle.median() < 0.05
    assert (angle < 1.0).float().mean() > 0.75


def _warp(
    camera: Camera, view: RenderedView, T_wc: np.ndarray, T_wc_other: np.ndarray
) -> np.ndarray:
    """Pixel (x, y) and depth in the other camera of every pixel."""
    T = torch.from_numpy(np.linalg.inv(T_wc_other) @ T_wc)
    points = camera.back_project(torch.from_numpy(view.depth).double())
    pixels, z = camera.project(points @ T[:3, :3].T + T[:3, 3])
    return torch.cat([pixels, z[..., None]], -1).numpy()


def test_two_views_agree(raycaster: Raycaster, poses: np.ndarray) -> None:
    """Warped into another frame, depth and colour are those seen there, but for occlusions."""
    camera = centred_camera(320, 240)
    first, second = (raycaster.render(camera, poses[i]) for i in (0, 6))
    warped = _warp(camera, first, poses[0], poses[6]).astype(np.float32)
    x, y = warped[..., 0], warped[..., 1]
    inside = (x > 1) & (x < 318) & (y > 1) & (y < 238)
    there = cv2.remap(second.depth, x, y, cv2.INTER_LINEAR)
    error = np.abs(there / warped[..., 2] - 1)[inside]
    assert inside.mean() > 0.6
    assert np.median(error) < 1e-4
    assert (error < 0.01).mean() > 0.93
    colour = cv2.remap(second.image, x, y, cv2.INTER_LINEAR)
    difference = np.abs(colour.astype(float) - first.image)[inside].mean(-1)
    assert np.median(difference) < 4
    assert np.median(difference) < 0.3 * first.image.std()


def test_optical_flow_works(raycaster: Raycaster, poses: np.ndarray) -> None:
    """DIS flow over six frames is consistent both ways and agrees with the true flow."""
    camera = centred_camera(320, 240)
    views = [raycaster.render(camera, poses[i]) for i in (20, 26)]
    grey = [cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY) for view in views]
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    forward, backward = dis.calc(grey[0], grey[1], None), dis.calc(grey[1], grey[0], None)
    grid = np.stack(np.meshgrid(np.arange(320), np.arange(240)), -1).astype(np.float32)
    there = grid + forward
    back = cv2.remap(backward, there[..., 0], there[..., 1], cv2.INTER_LINEAR, borderValue=1e3)
    consistent = np.linalg.norm(forward + back, axis=-1) < 1
    assert consistent.mean() > 0.7
    true = _warp(camera, views[0], poses[20], poses[26])[..., :2] - grid
    error = np.linalg.norm(forward - true, axis=-1)[consistent]
    assert np.median(error) < 0.3


def test_texture_is_everywhere(raycaster: Raycaster, poses: np.ndarray) -> None:
    """Nearly all 16 x 16 blocks hold detail, and the exposure suits."""
    view = raycaster.render(centred_camera(320, 240), poses[30])
    grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY).astype(float)
    blocks = grey.reshape(15, 16, 20, 16).std((1, 3))
    assert (blocks > 3).mean() > 0.95
    assert 70 < grey.mean() < 150
    assert (view.image == 255).all(-1).mean() < 0.02


def test_same_seed_same_image(raycaster: Raycaster, poses: np.ndarray) -> None:
    again = Raycaster(make_room(0), threads=2).render(CAMERA, poses[0])
    view = raycaster.render(CAMERA, poses[0])
    for name in ("image", "depth", "normal", "solid"):
        np.testing.assert_array_equal(getattr(view, name), getattr(again, name))


def test_resolution_keeps_geometry(raycaster: Raycaster, poses: np.ndarray) -> None:
    """A camera with a third of the pixels has its centres at every third pixel."""
    large = centred_camera(240, 180)
    small = large.resized(80, 60)
    fine, coarse = (raycaster.render(c, poses[5]) for c in (large, small))
    np.testing.assert_allclose(fine.depth[1::3, 1::3], coarse.depth, rtol=1e-6)
    assert math.isclose(small.cx, 39.5)


def test_light_reaches_cells_as_if_every_solid_was_asked(room: Scene) -> None:
    """Solids that are left out because they are far from a ray would not have been in its way."""
    s, rng = room.solids, np.random.default_rng(0)
    radius = np.linalg.norm(s.bounding_half, axis=1)
    solids = BoundedSolids(s.kind, s.half, s.rotation, s.centre, radius)
    sphere = rng.standard_normal((16, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    lights = np.array([[*(0.5 * room.size), 0.2], [*(0.2 * room.size), 0.05]])
    voxel, reach = 0.5, 0.7
    nx, ny, nz = np.ceil(room.size / voxel).astype(int)
    volume = np.zeros((nz, ny, nx, 3), np.float32)
    visibility_slices(solids, lights, sphere, reach, voxel, 0, nz, volume)

    def is_free(p, d, length):
        return all(crossing(solids, i, *p, *d, length, False) >= length for i in range(len(radius)))

    partly = 0
    for cell in rng.integers(0, (nz, ny, nx), (25, 3)):
        p = (cell[::-1] + 0.5) * voxel
        free = np.mean([is_free(p, d, reach) for d in sphere])
        assert volume[*cell, 0] == pytest.approx(min(1.0, 2 * free), abs=1e-6)
        for k, (*centre, size) in enumerate(lights):
            ends = np.array(centre) + size * sphere[::2] - p
            far = np.linalg.norm(ends, axis=1)
            seen = np.mean([is_free(p, e / n, n) for e, n in zip(ends, far, strict=True)])
            assert volume[*cell, 1 + k] == pytest.approx(seen, abs=1e-6)
            partly += 0 < seen < 1
    assert partly > 3
