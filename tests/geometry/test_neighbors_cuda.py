"""Neighbours and local planes by CUDA kernels against the k-d tree and PyTorch's eigh."""

import pytest
import torch

from cuda_emulator import use_emulator
from geogs.config import DiskConfig
from geogs.geometry import neighbors
from geogs.geometry.neighbors import all_pairs_neighbors, nearest_neighbors
from geogs.splat import init
from geogs.splat.init import (
    fit_local_planes,
    fit_local_planes_on_gpu,
    initialise_disks,
    principal_planes,
)

GPU = pytest.param(
    "cuda",
    marks=[
        pytest.mark.gpu,
        pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"),
    ],
)
CONFIG = DiskConfig(planarity_shrink=0.1)


@pytest.fixture(params=["cpu", GPU])
def device(request, monkeypatch):
    """The kernels emulated on the CPU, or on a GPU."""
    if request.param == "cpu":
        use_emulator(monkeypatch, neighbors, init)
    return torch.device(request.param)


def cloud(n: int, seed: int = 0) -> torch.Tensor:
    """Points on three walls of a room, with noise."""
    g = torch.Generator().manual_seed(seed)
    points = 4 * torch.rand(n, 3, generator=g)
    points[torch.arange(n), torch.arange(n) % 3] = 0.01 * torch.randn(n, generator=g)
    return points


def sizes(device: torch.device) -> tuple[int, int]:
    return (3000, 30_000) if device.type == "cuda" else (21, 2101)


@pytest.mark.parametrize("k", [1, 4, 13, 32])
def test_neighbours_are_those_of_the_tree(device, k):
    n, m = sizes(device)
    queries, points = cloud(n, 1), cloud(m, 2)
    expected, index = nearest_neighbors(queries, points, k)
    found = all_pairs_neighbors(queries.to(device), points.to(device), k).cpu()
    distance = (points[found] - queries[:, None]).norm(dim=-1)
    assert (distance - expected).abs().max() < 1e-6
    assert (found == index).double().mean() > 0.9999


def test_neighbours_of_points_among_themselves(device):
    points = cloud(1500, 3)
    found = all_pairs_neighbors(points[:17].to(device), points.to(device), 5).cpu()
    assert (found[:, 0] == torch.arange(17)).all()


def test_equal_distances_go_by_index_and_nearly_equal_points_are_told_apart(device):
    points = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, 1], [5, 5, 5]])
    found = all_pairs_neighbors(torch.zeros(1, 3, device=device), points.to(device), 4).cpu()
    assert found.tolist() == [[0, 1, 2, 3]]
    # Far from the origin, where |a|^2 - 2 a b + |b|^2 in float32 would know nothing.
    near = torch.tensor([100.0, 200.0, 300.0]) + 2.0**-13 * torch.arange(8.0)[:, None]
    found = all_pairs_neighbors(near[2:3].to(device), near.to(device), 3).cpu()
    assert found.tolist() == [[2, 1, 3]]


def test_fewer_points_than_neighbours(device):
    with pytest.raises(ValueError, match="5 neighbours of 3 points"):
        all_pairs_neighbors(torch.zeros(1, 3), torch.zeros(3, 3), 5)
    points = cloud(3).to(device)
    planes = fit_local_planes_on_gpu(points, points[:0], 12)
    expected = fit_local_planes(points.cpu(), points[:0].cpu(), 12)
    assert (planes.spacing.cpu() - expected.spacing).abs().max() < 1e-5


def test_local_planes_are_those_of_eigh(device):
    n, m = (2000, 20_000) if device.type == "cuda" else (40, 600)
    points, context = cloud(n, 4), cloud(m, 5)
    expected = fit_local_planes(points, context, 12)
    fitted = fit_local_planes_on_gpu(points.to(device), context.to(device), 12)
    assert (fitted.planarity.cpu() - expected.planarity).abs().max() < 1e-5
    assert ((fitted.spacing.cpu() - expected.spacing) / expected.spacing).abs().max() < 1e-5
    # Where two eigenvalues nearly agree their directions mean nothing.
    sure = expected.planarity > 0.02
    assert sure.double().mean() > 0.8
    assert (fitted.normal.cpu() * expected.normal).sum(-1).abs()[sure].min() > 1 - 1e-4
    assert (fitted.normal.cpu().norm(dim=-1) - 1).abs().max() < 1e-5
    assert (fitted.tangent.cpu().norm(dim=-1) - 1).abs().max() < 1e-5
    assert (fitted.normal * fitted.tangent).sum(-1).abs().max() < 1e-5


def test_eigenvectors_of_awkward_neighbourhoods(device):
    """A plane along the axes, a line, one point many times, and points far from the origin."""
    g = torch.Generator().manual_seed(6)
    square = torch.cat([torch.rand(8, 2, generator=g), torch.zeros(8, 1)], 1)
    line = torch.linspace(0, 1, 8)[:, None] * torch.tensor([1.0, 2.0, 3.0])
    same = torch.ones(8, 3)
    far = square * 0.01 + torch.tensor([50.0, -70.0, 90.0])
    points = torch.cat([square, line, same, far])
    neighbours = torch.arange(32).reshape(4, 8)
    normal, tangent, planarity, spacing = (
        x.cpu() for x in principal_planes(points.to(device), neighbours.to(device))
    )
    assert torch.isfinite(torch.cat([normal, tangent], 1)).all()
    assert (normal[[0, 3], 2].abs() > 1 - 1e-5).all()
    along = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, 3.0]), dim=0)
    assert abs(float(tangent[1] @ along)) > 1 - 1e-6
    assert planarity[1] < 1e-6
    assert planarity[2] == 0
    assert spacing[2] == 0
    centred = square.double() - square.double().mean(0)
    low, middle, high = torch.linalg.eigvalsh(centred.mT @ centred)
    assert abs(float(planarity[0]) - float((middle - low) / high)) < 1e-6


def test_disks_are_those_of_the_cpu(device, monkeypatch):
    n = 2000 if device.type == "cuda" else 40
    points, context = cloud(n, 7) + 1, cloud(600, 8) + 1
    centre, footprint = torch.tensor([2.0, 2.0, 2.5]), torch.full((n,), 0.2)
    expected = initialise_disks(points, centre, footprint, context, CONFIG)
    monkeypatch.setattr(init, "fit_local_planes", fit_local_planes_on_gpu)
    moved = (x.to(device) for x in (points, centre, footprint, context))
    made = initialise_disks(*moved, CONFIG)
    assert made.position.device.type == device.type
    assert (made.log_scale.cpu() - expected.log_scale).abs().max() < 1e-4
    same = (made.quaternion.cpu() * expected.quaternion).sum(-1).abs()
    # The sign of a tangent is arbitrary: a half turn about the normal makes the same disk.
    turned = made.quaternion.cpu()[:, [3, 2, 1, 0]] * torch.tensor([-1.0, 1, -1, 1])
    same = torch.maximum(same, (turned * expected.quaternion).sum(-1).abs())
    assert (same > 1 - 1e-3).double().mean() > 0.95
