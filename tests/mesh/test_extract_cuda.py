"""Fusion, extraction and colours on a GPU against those on the CPU."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from cuda_emulator import use_emulator
from geogs.application.machine.device import device_summary
from geogs.application.results.result_page import write_page, write_pictures
from geogs.application.results.surfaces import fusion_views, splat_colours
from geogs.config import MeshConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.io.writers.map_file import save_map
from geogs.io.writers.ply_writer import write_splats
from geogs.mesh.colour import colour_mesh
from geogs.mesh.extract import extract_mesh
from geogs.mesh.triangle_mesh import DepthMapView
from geogs.mesh.volume import tsdf
from geogs.mesh.volume.contraction import UNCONTRACTED, Contraction
from geogs.mesh.volume.pixel_planes import PixelPlanes, widest
from geogs.mesh.volume.tsdf import SparseTsdf, blocks_seen
from geogs.types import MapSnapshot, RenderedKeyframe, Trajectory

HAS_GPU = torch.cuda.is_available()
NEEDS_GPU = pytest.mark.skipif(not HAS_GPU, reason="needs a GPU")
GPU = pytest.param("cuda", marks=[pytest.mark.gpu, NEEDS_GPU])


def views(camera: Camera, count: int, seed: int = 0) -> list[DepthMapView]:
    """A wavy wall with a hole, seen from several places; uneven weights, a coloured image."""
    random = torch.Generator().manual_seed(seed)
    made = []
    for _ in range(count):
        twist = 0.15 * torch.randn(6, generator=random, dtype=torch.float64)
        T_cw = se3_exp(twist)
        rays = camera.rays(torch.float64)
        z = torch.full(rays.shape[:2], 2.0, dtype=torch.float64)
        for _ in range(30):  # the height field Z = 2 + 0.2 sin(3 X) by fixed-point steps
            X = (rays * z[..., None] - T_cw[:3, 3]) @ T_cw[:3, :3]
            z = z + 0.5 * (2 + 0.2 * torch.sin(3 * X[..., 0]) - X[..., 2])
        depth = z.float()
        depth[camera.height // 3 : camera.height // 2, : camera.width // 4] = 0
        weight = 0.5 + torch.rand(depth.shape, generator=random)
        grey = np.linspace(30, 220, camera.width * camera.height).reshape(depth.shape)
        image = np.stack([grey, grey[::-1], 255 - grey], -1).astype(np.uint8)
        made.append(DepthMapView(depth, weight, camera, T_cw, image))
    return made


def to_gpu(view: DepthMapView) -> DepthMapView:
    return replace(view, depth=view.depth.cuda(), weight=view.weight.cuda())


CONTRACTIONS = [UNCONTRACTED, Contraction((0.1, -0.2, 0.3), 1.8)]


@pytest.mark.parametrize("contraction", CONTRACTIONS)
def test_kernel_updates_voxels_like_torch(monkeypatch, contraction):
    use_emulator(monkeypatch, tsdf)
    camera = Camera(40.0, 41.0, 23.2, 19.7, 48, 40)
    expected, tested = (SparseTsdf(0.09, 3.0, contraction=contraction) for _ in range(2))
    for view in views(camera, 3):
        expected.integrate(view.depth, view.weight, camera, view.T_cw)
        valid = view.valid()
        planes = PixelPlanes.of(view.depth, valid, camera).grown(view.T_cw, contraction)
        tested._allocate(blocks_seen(planes, view.T_cw, 0.09, 3.0, contraction))
        table, truncation = planes.table(view.weight), planes.truncation(0.27)
        far = torch.where(valid, view.depth, 0.0).amax() + widest(0.27 * 4)
        tested.update_by_kernel(table, truncation, camera, view.T_cw, far)
    assert (tested.coordinates == expected.coordinates).all()
    seen = expected.weight > 0
    assert seen.double().mean() > 0.2
    agree = (tested.weight - expected.weight).abs() < 1e-4
    # A voxel that projects between two pixels may take the other one.
    assert agree.double().mean() > 0.9995
    assert (tested.distance - expected.distance)[agree].abs().max() < 1e-3


def test_blocks_out_of_view_stay_untouched(monkeypatch):
    use_emulator(monkeypatch, tsdf)
    camera = Camera(40.0, 41.0, 23.2, 19.7, 48, 40)
    (view,) = views(camera, 1)
    volume = SparseTsdf(0.09, 3.0)
    volume._allocate(torch.tensor([[0, 0, -4], [60, 0, 2], [0, -60, 2], [0, 0, 40], [0, 0, 2]]))
    planes = PixelPlanes.of(view.depth, view.valid(), camera)
    table, truncation = planes.table(view.weight), planes.truncation(0.27)
    volume.update_by_kernel(table, truncation, camera, view.T_cw, view.depth.amax() + 0.27)
    touched = (volume.weight > 0).flatten(1).any(1)
    assert touched.tolist() == [False, False, False, False, True]


@pytest.mark.gpu
@NEEDS_GPU
@pytest.mark.parametrize("contraction", CONTRACTIONS)
def test_fusion_on_a_gpu(contraction):
    camera = Camera(240.0, 240.0, 159.5, 89.5, 320, 180)
    volumes = [SparseTsdf(0.02, 4.0, d, contraction=contraction) for d in ("cpu", "cuda")]
    for view in views(camera, 8):
        volumes[0].integrate(view.depth, view.weight, camera, view.T_cw)
        volumes[1].integrate(view.depth.cuda(), view.weight.cuda(), camera, view.T_cw)
    expected, tested = volumes
    order, other = (tsdf.pack(v.coordinates.cpu()).argsort() for v in volumes)
    assert (expected.coordinates[order] == tested.coordinates.cpu()[other]).all()
    agree = (tested.weight.cpu()[other] - expected.weight[order]).abs() < 1e-3
    assert agree.double().mean() > 0.999
    difference = (tested.distance.cpu()[other] - expected.distance[order]).abs()
    assert difference[agree].max() < 1e-2


@pytest.mark.gpu
@NEEDS_GPU
def test_mesh_and_colours_on_a_gpu():
    camera = Camera(240.0, 240.0, 159.5, 89.5, 320, 180)
    on_cpu = views(camera, 8)
    on_gpu = [to_gpu(v) for v in on_cpu]
    expected, made = extract_mesh(on_cpu), extract_mesh(on_gpu)
    assert abs(len(made.faces) / len(expected.faces) - 1) < 0.01
    assert made.colours is not None
    assert made.vertices.dtype == np.float32
    again = colour_mesh(expected, on_gpu, 0.05).colours
    same = colour_mesh(expected, on_cpu, 0.05).colours
    assert (np.abs(again.astype(int) - same.astype(int)).max(1) <= 1).mean() > 0.999


@pytest.mark.parametrize(
    "device", ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, NEEDS_GPU])]
)
def test_results_are_written_from_any_device(device, tmp_path):
    camera = Camera(40.0, 41.0, 23.2, 19.7, 48, 40)
    renders = [
        RenderedKeyframe(
            keyframe_id=i,
            camera=camera,
            T_cw=v.T_cw.to(device),
            depth=v.depth.to(device),
            normal=torch.tensor([0.0, 0.0, -1.0]).expand(40, 48, 3).to(device),
            weight=v.weight.to(device),
            image=v.image,
            timestamp=float(i),
        )
        for i, v in enumerate(views(camera, 6))
    ]
    depth_maps = fusion_views(renders)
    mesh = extract_mesh(depth_maps, MeshConfig(min_component_faces=10))
    points = torch.from_numpy(mesh.vertices[::20]).to(device)
    n = len(points)
    quaternion = torch.tensor([0, 1.0, 0, 0], device=device).expand(n, 4)
    scale, opacity = torch.full((n, 2), 0.05, device=device), torch.full((n,), 0.8, device=device)
    disks = MapSnapshot(points, quaternion, scale, opacity)
    colours = splat_colours(disks, depth_maps)
    assert colours.shape == (n, 3)
    assert colours.std() > 0.02
    write_splats(tmp_path / "splats.ply", disks, colours)
    save_map(tmp_path / "map.safetensors", disks)
    T_wc = np.stack([torch.linalg.inv(r.T_cw.cpu()).numpy() for r in renders])
    trajectory = Trajectory(np.arange(6.0), T_wc, np.ones(6, bool))
    write_pictures(tmp_path / "report", renders)
    write_page(tmp_path / "report", trajectory, renders, mesh, {"source": "room"})
    for name in ("trajectory", "keyframes"):
        assert (tmp_path / "report" / f"{name}.png").stat().st_size > 5000
    summary = device_summary(disks.position.device)
    assert (summary["device"] == "cpu") == (device == "cpu")
