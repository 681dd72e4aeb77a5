"""The steps from a volume to its mesh on a device against those of the host."""

import numpy as np
import pytest
import torch

from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.mesh.clean import border_edges, cleaned, components_on_host, vertex_components
from geogs.mesh.decimation.decimate import device_deviations, host_deviations, triangle_distances
from geogs.mesh.decimation.decimation_kernels import triangle_distance
from geogs.mesh.tensor_mesh import TensorMesh
from geogs.mesh.volume.free_space import FreeSpace
from geogs.mesh.volume.level_set import device_surface, extract_surface
from geogs.mesh.volume.tsdf import SparseTsdf
from surface_shapes import hills

GPU = pytest.param(
    "cuda",
    marks=[
        pytest.mark.gpu,
        pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"),
    ],
)
DEVICES = pytest.mark.parametrize("device", ["cpu", GPU])


def volume(device: str = "cpu") -> SparseTsdf:
    """Noisy depths of a slanted wall with gaps, seen twice, and specks before it."""
    camera, random = Camera(80.0, 80.0, 47.5, 35.5, 96, 72), torch.Generator().manual_seed(0)
    tsdf = SparseTsdf(0.03, 4.0, device)
    for _ in range(2):
        depth = 2 + 0.004 * torch.arange(96.0)[None] + 0.01 * torch.randn(72, 96, generator=random)
        depth[torch.rand(72, 96, generator=random) < 0.02] = 0
        depth[30:34, 40:44] = 1.2
        pose = torch.eye(4, dtype=torch.float64)
        tsdf.integrate(depth.to(device), torch.ones(72, 96, device=device), camera, pose)
    return tsdf


def host(tsdf: SparseTsdf) -> SparseTsdf:
    """A copy on the host."""
    copied = SparseTsdf(tsdf.voxel, tsdf.truncation)
    for name in ("_keys", "_slots", "coordinates", "_distance", "_weight"):
        setattr(copied, name, getattr(tsdf, name).cpu())
    return copied


def triangles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Corners of all faces, each from its first, in an order of their own."""
    corners = vertices[faces].reshape(-1, 3, 3)
    keys = corners.round(5).astype(np.float64) @ np.array([1e6, 1e3, 1.0])
    first = keys.argmin(1)[:, None]
    turned = np.take_along_axis(corners, ((first + np.arange(3)) % 3)[..., None], axis=1)
    return turned[np.lexsort(turned.reshape(len(turned), 9).round(5).T)]


def assert_same_surface(made: TensorMesh, expected: TensorMesh) -> None:
    assert len(made.vertices) == len(expected.vertices)
    assert len(made.faces) == len(expected.faces) > 1000
    np.testing.assert_allclose(
        triangles(made.vertices.cpu().numpy(), made.faces.cpu().numpy()),
        triangles(expected.vertices.numpy(), expected.faces.numpy()),
        atol=1e-6,
    )


@DEVICES
@pytest.mark.parametrize("batch", [5, 100_000])
def test_the_surface_is_that_of_the_host(device, batch, monkeypatch):
    monkeypatch.setattr("geogs.mesh.volume.level_set._BATCH", batch)
    tsdf = volume(device)
    assert len(tsdf) > 50
    assert_same_surface(device_surface(tsdf, 1.5), extract_surface(host(tsdf), 1.5))


@DEVICES
@pytest.mark.parametrize("most", [None, 2])
def test_it_is_cleaned_as_on_the_host(device, most):
    config, tsdf = MeshConfig(min_component_faces=8, max_components=most), volume(device)
    expected = extract_surface(host(tsdf), 1.5)
    before = expected
    expected, up = cleaned(expected, config, FreeSpace.of(host(tsdf), 1.5))
    assert len(expected.faces) != len(before.faces)
    made, normals = cleaned(device_surface(tsdf, 1.5), config, FreeSpace.of(tsdf, 1.5))
    assert_same_surface(made, expected)
    order, other = (np.lexsort(v.vertices.cpu().numpy().round(5).T) for v in (made, expected))
    np.testing.assert_allclose(normals.cpu().numpy()[order], up.numpy()[other], atol=1e-4)


def test_without_a_surface_the_error_is_that_of_the_host():
    for tsdf, weight in ((volume(), 99.0), (SparseTsdf(0.1), 1.5)):
        found, config = device_surface(tsdf, weight), MeshConfig(min_weight=weight)
        with pytest.raises(
            InputError, match=f"No surface was seen with a total weight of {weight:g}"
        ):
            cleaned(found, config, FreeSpace.of(tsdf, weight))


@pytest.mark.parametrize("count", [1, 30, 300, 2000])
def test_borders_and_components_of_any_faces(count):
    random = np.random.default_rng(count)
    faces = random.integers(0, 400, (count, 3)).astype(np.int32)
    mesh = TensorMesh(torch.zeros(400, 3), torch.from_numpy(faces).long())
    edges = {(f[k], f[(k + 1) % 3]) for f in faces.tolist() for k in range(3)}
    expected = {(a, b) for a, b in edges if (b, a) not in edges}
    found = [tuple(edge) for edge in border_edges(mesh).tolist()]
    assert sorted(found) == sorted(expected)
    label, before = np.arange(400), None
    while not np.array_equal(label, before):
        before = label.copy()
        for face in faces:
            label[face] = label[face].min()
    assert vertex_components(mesh).tolist() == label.tolist()
    part = np.unique(label, return_inverse=True)[1]
    assert components_on_host(mesh).tolist() == part.tolist()


@DEVICES
def test_deviations_are_those_of_the_host(device):
    mesh = hills(30)
    random = np.random.default_rng(0)
    points = (mesh.vertices + 0.03 * random.normal(size=mesh.vertices.shape)).astype(np.float32)
    given = points, mesh.vertices, mesh.faces, random.permutation(len(points))
    arrays = [torch.from_numpy(x).to(device) for x in given]
    expected = host_deviations(*given)
    np.testing.assert_allclose(device_deviations(*arrays).cpu(), expected, atol=1e-6)


def test_distances_to_triangles_are_those_of_the_host():
    random = np.random.default_rng(0)
    points, corners = random.normal(size=(200, 3)), random.normal(size=(200, 3, 3))
    corners[::10, 2] = 0.5 * (corners[::10, 0] + corners[::10, 1])
    made = triangle_distances(torch.from_numpy(points), torch.from_numpy(corners))
    expected = [triangle_distance(*pair) for pair in zip(points, corners, strict=True)]
    np.testing.assert_allclose(made, expected, atol=1e-9)
