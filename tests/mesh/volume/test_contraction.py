"""Volumes whose far end is drawn together."""

import math

import numpy as np
import pytest
import torch

from geogs.config import MeshConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.mesh.extract import VolumePlan, extract_mesh, plan_volume
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.mesh.volume.contraction import UNCONTRACTED, Contraction
from geogs.mesh.volume.pixel_planes import PixelPlanes
from geogs.mesh.volume.tsdf import BLOCK, SparseTsdf

CAMERA = Camera(fx=120.0, fy=120.0, cx=79.5, cy=59.5, width=160, height=120)
SPACE = Contraction((0.3, -0.2, 0.5), 2.0)
BALL, BALL_AT, HALL = 0.4, torch.tensor([0.0, 0.0, 1.5], dtype=torch.float64), 60.0


def scattered(count: int) -> torch.Tensor:
    """Points of the world at all distances from nearby to a thousand radii."""
    random = torch.Generator().manual_seed(3)
    away = torch.randn(count, 3, generator=random, dtype=torch.float64)
    distance = torch.logspace(-1, 3.3, count, dtype=torch.float64)[:, None]
    middle = torch.tensor(SPACE.centre, dtype=torch.float64)
    return middle + distance * torch.nn.functional.normalize(away, dim=-1)


def test_what_is_contracted_is_expanded_to_where_it_was():
    points = scattered(400)
    contracted, middle = SPACE.contracted(points), points.new_tensor(SPACE.centre)
    distance = (points - middle).norm(dim=-1)
    near = distance < SPACE.radius
    assert 50 < near.sum() < 350
    torch.testing.assert_close(contracted[near], points[near], rtol=0, atol=1e-14)
    expected = SPACE.radius * (2 - SPACE.radius / distance[~near])
    torch.testing.assert_close((contracted - middle).norm(dim=-1)[~near], expected)
    torch.testing.assert_close(SPACE.expanded(contracted), points, rtol=1e-8, atol=1e-9)
    beyond = SPACE.expanded(middle + torch.tensor([[0.0, 5.0, 0.0]]).double())
    assert torch.isfinite(beyond).all()
    assert beyond.abs().max() > 1e5


def test_steps_grow_as_the_derivative_says():
    points = scattered(60)
    grown = SPACE.growth(points)
    for point, growth in zip(SPACE.contracted(points), grown, strict=True):
        jacobian = torch.autograd.functional.jacobian(SPACE.expanded, point)
        assert isinstance(jacobian, torch.Tensor)
        longest = torch.linalg.svdvals(jacobian).max()
        assert float(growth) == pytest.approx(float(longest), rel=1e-6)


def test_balls_hold_what_they_stand_for():
    random = torch.Generator().manual_seed(4)
    middle = SPACE.contracted(scattered(200))
    centre, reach = SPACE.balls(middle, 0.05)
    step = torch.nn.functional.normalize(
        torch.randn(200, 50, 3, generator=random, dtype=torch.float64), dim=-1
    )
    away = (SPACE.expanded(middle[:, None] + 0.05 * step) - centre[:, None]).norm(dim=-1)
    within = (middle - middle.new_tensor(SPACE.centre)).norm(dim=-1) < 2 * SPACE.radius - 0.06
    assert 100 < within.sum() < 200
    reach = torch.as_tensor(reach)
    assert (away <= reach[:, None] * (1 + 1e-9))[within].all()
    ordinary = (middle - middle.new_tensor(SPACE.centre)).norm(dim=-1) < SPACE.radius - 0.05
    torch.testing.assert_close(reach[ordinary], torch.full_like(reach[ordinary], 0.05))


def test_each_voxel_is_averaged_where_it_lies_in_the_world():
    """Against a loop over the voxels, each expanded and projected by itself."""
    camera = Camera(40.0, 41.0, 23.2, 19.7, 48, 40)
    T_cw = se3_exp(torch.tensor([0.1, -0.2, 0.3, 0.05, 0.4, -0.1], dtype=torch.float64))
    rays = camera.rays(torch.float64)
    depth = (2 + 0.3 * rays[..., 0] + 20 * (rays[..., 1] > 0.1)).float()
    weight = torch.full_like(depth, 0.7)
    volume = SparseTsdf(0.05, 3.0, contraction=SPACE)
    volume.integrate(depth, weight, camera, T_cw)
    planes = PixelPlanes.of(depth, depth > 0, camera)
    at = (rays / planes.inverse[..., None] - T_cw[:3, 3]) @ T_cw[:3, :3]
    reach = planes.truncation(0.15).view_as(depth) * SPACE.growth(at)
    random, seen, far = np.random.default_rng(5), 0, 0
    for number in random.integers(0, len(volume), 300):
        inner = random.integers(0, BLOCK, 3)
        voxel = volume.coordinates[number] * BLOCK + torch.from_numpy(inner)
        place = SPACE.expanded(voxel.double() * 0.05)
        x, y, z = (T_cw[:3, :3] @ place + T_cw[:3, 3]).tolist()
        u, v = 40.0 * x / z + 23.2, 41.0 * y / z + 19.7
        if z <= 0 or not (-0.49 < u < 47.49 and -0.49 < v < 39.49):
            continue
        if min(abs(u % 1 - 0.5), abs(v % 1 - 0.5)) < 0.01:
            continue
        row, column = round(v), round(u)
        inverse = planes.inverse[row, column] + planes.right[row, column] * (u - column)
        inverse = inverse + planes.down[row, column] * (v - row)
        ahead = float((1 / inverse - z) / reach[row, column])
        got = volume.weight[number, inner[0], inner[1], inner[2]]
        assert float(got) == pytest.approx(0.7 * min(max(2 + 2 * ahead, 0), 1), abs=2e-3)
        if ahead > -0.98:
            value = float(volume.distance[number, inner[0], inner[1], inner[2]])
            assert value == pytest.approx(min(ahead, 1.0), abs=2e-3)
            seen += 1
            far += z > 8
    assert seen > 60
    assert 10 < far < seen - 10


def ball_before_a_hall(count: int = 12) -> list[DepthMapView]:
    """A ball, seen from around it in a hall that is 150 times as large."""
    views = []
    for k in range(count):
        turn = 2 * math.pi * k / count
        T = se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, turn, 0.0], dtype=torch.float64))
        T[:3, 3] += BALL_AT
        origin = -T[:3, :3].mT @ T[:3, 3]
        d = CAMERA.rays(torch.float64) @ T[:3, :3]
        a, b = (d * d).sum(-1), d @ origin
        far = (-b + (b * b - a * (origin @ origin - HALL**2)).sqrt()) / a
        root = b * b - a * (origin @ origin - BALL**2)
        depth = torch.where(root > 0, (-b - root.clamp(min=0).sqrt()) / a, far)
        views.append(DepthMapView(depth.float(), torch.ones(120, 160), CAMERA, T))
    return views


@pytest.fixture(scope="module")
def whole() -> tuple[VolumePlan, Mesh]:
    """The ball before the hall, with all of its triangles."""
    views, config = ball_before_a_hall(), MeshConfig(triangle_budget=300_000, detail=0)
    return plan_volume(views, config), extract_mesh(views, config)


def test_what_is_near_keeps_its_shape_before_a_far_background(whole):
    plan, mesh = whole
    assert plan.contraction.centre == pytest.approx((0, 0, 0), abs=1e-9)
    assert plan.voxel < BALL / 10
    distance = np.linalg.norm(mesh.vertices.astype(np.float64), axis=1)
    near, far = distance[distance < 1], distance[distance > 0.8 * HALL]
    assert len(near) + len(far) == len(distance)
    assert len(near) > 1000
    assert np.abs(near - BALL).max() < plan.voxel
    assert np.abs(near - BALL).mean() < plan.voxel / 8
    assert len(far) > 1000
    assert np.abs(far / HALL - 1).mean() < 0.01  # a voxel there is 17


def test_merged_triangles_stay_where_the_surface_is(whole):
    plan, all_triangles = whole
    mesh = extract_mesh(ball_before_a_hall(), MeshConfig(triangle_budget=300_000))
    assert len(mesh.faces) < 0.7 * len(all_triangles.faces)
    distance = np.linalg.norm(mesh.vertices.astype(np.float64), axis=1)
    assert np.abs(distance[distance < 1] - BALL).max() < 2 * plan.voxel
    outwards = (mesh.normals * mesh.vertices).sum(1) / distance
    assert np.median(outwards[distance < 1]) > 0.98
    assert (outwards[distance > 1] < 0).mean() > 0.99
    assert np.abs(distance[distance > 1] / HALL - 1).mean() < 0.03


def test_without_a_background_nothing_is_contracted():
    views = ball_before_a_hall()
    for view in views:
        view.weight[view.depth > 3] = 0
    assert plan_volume(views, MeshConfig()).contraction == UNCONTRACTED
