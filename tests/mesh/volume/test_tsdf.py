"""Fusion and extraction against analytic shapes seen by analytic ray casting."""

import math

import numpy as np
import pytest
import torch

from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.mesh import clean
from geogs.mesh.clean import large_components, remove_degenerate_faces
from geogs.mesh.extract import extract_mesh, plan_volume
from geogs.mesh.tensor_mesh import TensorMesh
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.mesh.volume import level_set
from geogs.mesh.volume.level_set import extract_surface
from geogs.mesh.volume.tsdf import BLOCK, SparseTsdf, band_blocks, pack, unpack

CAMERA = Camera(fx=120.0, fy=120.0, cx=79.5, cy=59.5, width=160, height=120)
RADIUS = 0.4


def look_at(position: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """World to camera, z towards the target."""
    z = torch.nn.functional.normalize(target - position, dim=0)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    if abs(float(z @ up)) > 0.9:
        up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    x = torch.nn.functional.normalize(torch.linalg.cross(z, up), dim=0)
    R = torch.stack([x, torch.linalg.cross(z, x), z])
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3], T[:3, 3] = R, -R @ position
    return T


def cast(T_cw: torch.Tensor, camera: Camera = CAMERA) -> tuple[torch.Tensor, torch.Tensor]:
    """Origin and directions (z = 1) of the pixels' rays in the world."""
    origin = -T_cw[:3, :3].T @ T_cw[:3, 3]
    return origin, camera.rays(torch.float64) @ T_cw[:3, :3]


def sphere_depth(T_cw: torch.Tensor) -> torch.Tensor:
    origin, d = cast(T_cw)
    a, b, c = (d * d).sum(-1), d @ origin, origin @ origin - RADIUS**2
    root = b * b - a * c
    return torch.where(root > 0, (-b - root.clamp(min=0).sqrt()) / a, 0.0).float()


def box_depth(T_cw: torch.Tensor, half: torch.Tensor) -> torch.Tensor:
    """Nearest inner wall of a box around the origin, for a camera inside."""
    origin, d = cast(T_cw)
    t = (torch.sign(d) * half - origin) / torch.where(d.abs() < 1e-12, 1e-12, d)
    return t.amin(-1).float()


def sphere_views(count: int = 30) -> list[DepthMapView]:
    views = []
    for k in range(count):  # Fibonacci lattice
        z = 1 - (2 * k + 1) / count
        angle = k * math.pi * (3 - 5**0.5)
        r = (1 - z * z) ** 0.5
        position = 1.5 * torch.tensor([r * math.cos(angle), r * math.sin(angle), z]).double()
        T = look_at(position, torch.zeros(3).double())
        depth = sphere_depth(T)
        image = np.zeros((60, 80, 3), np.uint8)
        image[...] = (200, 100, 50)
        views.append(DepthMapView(depth, (depth > 0).float(), CAMERA, T, image))
    return views


def box_views(half: torch.Tensor, count: int = 24) -> list[DepthMapView]:
    views = []
    for k in range(count):
        yaw, pitch = 2 * math.pi * k / count, 0.9 * math.sin(2.4 * k)
        target = torch.tensor(
            [math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)]
        ).double()
        position = 0.2 * torch.tensor([math.sin(5.0 * k), math.cos(3.0 * k), 0.3]).double()
        T = look_at(position, position + target)
        depth = box_depth(T, half)
        views.append(DepthMapView(depth, torch.ones_like(depth), CAMERA, T))
    return views


def boundary_edges(mesh: Mesh) -> np.ndarray:
    """Edges that do not belong to exactly two faces."""
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
    unique, count = np.unique(edges, axis=0, return_counts=True)
    return unique[count != 2]


def by_position(mesh: Mesh) -> np.ndarray:
    """Faces by the ranks of their vertices, in an order that does not depend on numbering."""
    order = np.lexsort(np.round(mesh.vertices, 5).T)
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    faces = rank[mesh.faces]
    first = faces.argmin(1)[:, None]
    faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    return faces[np.lexsort(faces.T)]


def face_normals(mesh: Mesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    normal = np.cross(b - a, c - a)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def test_keys_round_trip():
    xyz = torch.tensor([[0, 0, 0], [-1, 5, -700000], [1048575, -1048576, 3]])
    assert torch.equal(unpack(pack(xyz)), xyz)
    ordered = torch.cartesian_prod(*[torch.arange(-2, 3)] * 3)
    assert torch.equal(pack(ordered).sort().values, pack(ordered))


@pytest.mark.parametrize("truncation", [2.0, 4.0, 5.5])
def test_band_holds_every_voxel_within_truncation(truncation):
    generator = torch.Generator().manual_seed(0)
    voxel = 0.03
    points = torch.rand(200, 3, generator=generator, dtype=torch.float64) * 4 - 2
    blocks = set(map(tuple, band_blocks(points, voxel, truncation).tolist()))
    offset = (torch.rand(50, 3, generator=generator, dtype=torch.float64) * 2 - 1) * truncation
    near = (points[:, None] / voxel + offset).flatten(0, 1)
    needed = torch.floor(near / BLOCK).long()
    assert all(tuple(b) in blocks for b in needed.tolist())
    assert len(blocks) <= 200 * math.ceil((2 * truncation + 4) / BLOCK + 1) ** 3


def test_sphere_is_accurate_closed_and_faces_outwards():
    views, voxel = sphere_views(), 0.02
    mesh = extract_mesh(views, MeshConfig(voxel=voxel, detail=0))
    radius = np.linalg.norm(mesh.vertices.astype(np.float64), axis=1)
    assert np.abs(radius - RADIUS).mean() < voxel / 15
    assert np.abs(radius - RADIUS).max() < voxel / 3
    assert len(boundary_edges(mesh)) == 0
    euler = len(mesh.vertices) - len(mesh.faces) * 3 // 2 + len(mesh.faces)
    assert euler == 2  # one closed sphere, no back side, no seams
    centre = mesh.vertices[mesh.faces].mean(1)
    outwards = (face_normals(mesh) * centre / np.linalg.norm(centre, axis=1, keepdims=True)).sum(1)
    assert outwards.min() > 0.8
    assert (mesh.normals * mesh.vertices).sum(1).min() > 0.9 * RADIUS
    assert (mesh.colours == (200, 100, 50)).all()
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(4 * math.pi * RADIUS**2, rel=0.01)


def extracted(tsdf: SparseTsdf, min_weight: float) -> Mesh:
    found = extract_surface(tsdf, min_weight)
    return Mesh.from_triangles(found.vertices.numpy(), found.faces.numpy())


def test_box_from_inside_spans_chunks_without_seams(monkeypatch):
    half, voxel = torch.tensor([1.3, 1.1, 0.9]).double(), 0.015  # two chunks and more per axis
    views = box_views(half)
    tsdf = SparseTsdf(voxel)
    for v in views:
        tsdf.integrate(v.depth, v.weight, v.camera, v.T_cw)
    assert (tsdf.coordinates.amax(0) - tsdf.coordinates.amin(0)).min() > 14
    mesh = extracted(tsdf, min_weight=1.0)
    distance = np.abs(np.abs(mesh.vertices) - half.numpy()).min(1)
    assert distance.mean() < voxel / 20
    assert np.quantile(distance, 0.99) < voxel / 3
    inwards = -(face_normals(mesh) * mesh.vertices[mesh.faces].mean(1)).sum(1)
    assert (inwards > 0).mean() > 0.9999  # no back faces
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
    monkeypatch.setattr(level_set, "CHUNK", 64)  # all in one piece, of course without seams
    whole = extracted(tsdf, min_weight=1.0)
    assert np.array_equal(by_position(mesh), by_position(whole))


def test_pixel_planes_are_exact_on_a_slanted_wall():
    """One view of a plane at 60 degrees: the zero level is the plane to 1 % of a voxel."""
    normal = torch.tensor([math.sin(math.radians(60)), 0.0, -math.cos(math.radians(60))]).double()
    rays = CAMERA.rays(torch.float64)
    depth = -1.0 / (rays @ normal)
    depth = torch.where((depth > 0) & (depth < 4), depth, 0.0).float()
    tsdf = SparseTsdf(0.02)
    tsdf.integrate(depth, torch.ones_like(depth), CAMERA, torch.eye(4, dtype=torch.float64))
    mesh = extracted(tsdf, 1.0)
    distance = np.abs(mesh.vertices @ normal.numpy() + 1.0)
    assert np.quantile(distance, 0.95) < 0.0002
    assert len(mesh.faces) > 5000


def test_depth_step_does_not_bleed():
    """Two walls one behind the other: no vertex floats between them."""
    depth = torch.full((120, 160), 2.0)
    depth[:, 80:] = 1.0
    tsdf = SparseTsdf(0.02)
    tsdf.integrate(depth, torch.ones_like(depth), CAMERA, torch.eye(4, dtype=torch.float64))
    z = extracted(tsdf, 1.0).vertices[:, 2]
    assert ((np.abs(z - 1) < 0.09) | (np.abs(z - 2) < 0.001)).all()
    assert (np.abs(z - 1) < 1e-3).sum() > 1000


def test_later_free_space_removes_a_floater():
    wall = torch.full((120, 160), 2.0)
    floater = wall.clone()
    floater[50:70, 70:90] = 1.0
    eye = torch.eye(4, dtype=torch.float64)
    views = [DepthMapView(floater, torch.ones_like(wall), CAMERA, eye)]
    views += [DepthMapView(wall, torch.ones_like(wall), CAMERA, eye)] * 3
    mesh = extract_mesh(views, MeshConfig(voxel=0.02, min_component_faces=1))
    assert (mesh.vertices[:, 2] > 1.5).all()
    both = extract_mesh(views[:1], MeshConfig(voxel=0.02, min_weight=1.0, min_component_faces=1))
    assert (both.vertices[:, 2] < 1.5).any()


def test_weights_average_and_bad_pixels_are_left_out():
    eye = torch.eye(4, dtype=torch.float64)
    near, far = torch.full((120, 160), 1.00), torch.full((120, 160), 1.03)
    near[:10] = float("nan")
    far[:10] = float("inf")
    tsdf = SparseTsdf(0.02)
    tsdf.integrate(near, torch.full_like(near, 3.0), CAMERA, eye)
    tsdf.integrate(far, torch.full_like(far, 1.0), CAMERA, eye)
    mesh = extracted(tsdf, 4.0)
    middle = mesh.vertices[np.abs(mesh.vertices[:, :2]).max(1) < 0.2]
    assert np.abs(middle[:, 2] - 1.0075).max() < 1e-3
    assert mesh.vertices[:, 1].min() > (10 - 1 - CAMERA.cy) / CAMERA.fy
    assert torch.isfinite(tsdf.distance).all()
    assert torch.isfinite(tsdf.weight).all()
    assert len(extracted(tsdf, 4.1).faces) == 0


def test_stray_points_far_away_do_no_harm():
    depth = torch.full((120, 160), 1.0)
    depth[:2] = 1e9
    tsdf = SparseTsdf(0.02)
    tsdf.integrate(depth, torch.ones_like(depth), CAMERA, torch.eye(4, dtype=torch.float64))
    mesh = extracted(tsdf, 1.0)
    assert np.abs(mesh.vertices[:, 2] - 1).max() < 0.1
    assert len(mesh.faces) > 1000


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_gpu_gives_the_same_mesh():
    views = sphere_views(10)
    moved = [DepthMapView(v.depth.cuda(), v.weight.cuda(), v.camera, v.T_cw) for v in views]
    here, there = (extract_mesh(v, MeshConfig(voxel=0.02, colour=False)) for v in (views, moved))
    assert len(there.faces) == pytest.approx(len(here.faces), rel=1e-3)
    radius = np.linalg.norm(there.vertices, axis=1)
    assert np.abs(radius - RADIUS).mean() < 0.002


def test_rigid_motion_of_all_views_moves_the_mesh():
    views = sphere_views(12)
    move = se3_exp(torch.tensor([3.0, -2.0, 5.0, 0.4, 0.3, -0.8], dtype=torch.float64))
    moved = [DepthMapView(v.depth, v.weight, v.camera, v.T_cw @ move.inverse()) for v in views]
    mesh = extract_mesh(moved, MeshConfig(voxel=0.02, detail=0))
    radius = np.linalg.norm(mesh.vertices - move[:3, 3].numpy(), axis=1)
    assert np.abs(radius - RADIUS).mean() < 0.0015


def test_plan_follows_pixel_budget_and_memory(monkeypatch):
    monkeypatch.setattr(clean, "CLOSED_HOLES", 0)
    views = sphere_views(6)
    plan = plan_volume(views, MeshConfig())
    assert plan.voxel == pytest.approx(1.2 / 120, rel=0.15)  # one pixel at about 1.2 m
    assert plan.max_depth == pytest.approx(2 * 1.4, rel=0.1)
    small = plan_volume(views, MeshConfig(triangle_budget=2000))
    config = MeshConfig(triangle_budget=2000, min_weight=1.0, detail=0)
    faces = len(extract_mesh(views, config).faces)
    assert small.voxel > 2 * plan.voxel
    assert 1000 < faces < 2400
    tight = plan_volume(views, MeshConfig(memory_limit=1e-3))
    assert tight.bytes <= 1e-3 * 2**30
    with pytest.raises(InputError, match="larger voxel"):
        plan_volume(views, MeshConfig(voxel=0.005, memory_limit=1e-3))


@pytest.mark.parametrize(
    ("voxel", "said"), [(1e-6, "too small: the volume would end at 0.524"), (1e6, "min-weight")]
)
def test_voxels_that_do_not_fit_the_scene_are_refused_in_a_sentence(voxel, said):
    pose = look_at(torch.tensor([0.1, 0.0, 0.0]).double(), torch.tensor([1.0, 0.2, 0.1]).double())
    depth = box_depth(pose, torch.tensor([1.3, 1.1, 0.9]).double())
    view = DepthMapView(depth, torch.ones_like(depth), CAMERA, pose)
    with pytest.raises(InputError, match=said):
        extract_mesh([view], MeshConfig(voxel=voxel))


def test_estimate_of_blocks_is_near_the_truth():
    views = sphere_views(12)
    plan = plan_volume(views, MeshConfig(voxel=0.02))
    tsdf = SparseTsdf(0.02)
    for v in views:
        tsdf.integrate(v.depth, v.weight, v.camera, v.T_cw)
    assert plan.blocks == pytest.approx(len(tsdf), rel=0.1)


def test_nothing_to_extract_is_an_input_error():
    with pytest.raises(InputError, match="no depth maps"):
        extract_mesh([])
    empty = torch.zeros(120, 160)
    view = DepthMapView(empty, empty + 1, CAMERA, torch.eye(4, dtype=torch.float64))
    with pytest.raises(InputError, match="No depth map has a valid pixel"):
        extract_mesh([view])
    one = sphere_views(1)
    with pytest.raises(InputError, match="min-weight"):
        extract_mesh(one, MeshConfig(voxel=0.02, min_weight=1.5))


def two_parts() -> Mesh:
    """A fan of six faces, far from it a single face and one without area."""
    ring = [[math.cos(a), math.sin(a), 0] for a in np.arange(6) * math.pi / 3]
    vertices = [[0, 0, 0], *ring, [5, 0, 0], [6, 0, 0], [5, 1, 0], [7, 0, 0]]
    faces = [[0, 1 + k, 1 + (k + 1) % 6] for k in range(6)]
    faces += [[7, 8, 9], [7, 8, 10], [7, 7, 9]]
    return Mesh.from_triangles(np.array(vertices, np.float32), np.array(faces, np.int32))


def test_clean_removes_degenerate_faces_and_small_parts():
    mesh = remove_degenerate_faces(two_parts())
    assert len(mesh.faces) == 7
    assert len(mesh.vertices) == 10  # vertex 10 is unused now
    parts = TensorMesh.of(mesh.vertices, mesh.faces)
    assert len(large_components(parts, 1, 0.0, None).faces) == 7
    largest = large_components(parts, 2, 0.0, None)
    assert len(largest.faces) == 6
    assert largest.vertices.abs().max() <= 1
    assert len(large_components(parts, 1, 0.5, None).faces) == 6
    assert len(large_components(parts, 1, 0.0, 1).faces) == 6
    assert np.allclose(largest.normals(), [0, 0, 1])
