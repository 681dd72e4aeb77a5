"""Correlation windows: kernels against the obvious computation, forward and backward."""

import numpy as np
import pytest
import torch

import geogs.tracking.flow.lookup as lookup
from cuda_emulator import use_emulator
from geogs.tracking.flow.lookup import (
    CHANNELS,
    CorrelationVolume,
    DescriptorPyramid,
    Edges,
    PyramidLevel,
    correlation_windows,
    correlation_windows_reference,
    level_tables,
)

LEVELS = (PyramidLevel(17, 12, 0.25, 0.0), PyramidLevel(9, 6, 0.125, -0.25))


@pytest.fixture
def problem():
    rng = torch.Generator().manual_seed(3)
    source = torch.randn(3, 20, CHANNELS, generator=rng).bfloat16().float()
    total = sum(level.width * level.height for level in LEVELS)
    target = torch.randn(3, total, CHANNELS, generator=rng).bfloat16().float()
    edges = Edges(torch.tensor([0, 2, 1], dtype=torch.int32), torch.tensor([1, 0, 1]).int())
    # Inside, across the border, far outside.
    centres = torch.rand(3, 20, 2, generator=rng) * 90 - 12
    centres[0, 0] = torch.tensor([1e5, -1e5])
    centres[1, 0] = torch.tensor([float("nan"), 3.0])
    return source, DescriptorPyramid(target, LEVELS), edges, centres


def reference(source, pyramid, edges, centres):
    """The windows by loops over everything, float64."""
    out = torch.zeros(*centres.shape[:2], len(LEVELS), 7, 7, dtype=torch.float64)
    table, _ = level_tables(pyramid.levels)
    for e, (i, j) in enumerate(zip(edges.first.tolist(), edges.second.tolist(), strict=True)):
        for p, (x, y) in enumerate(centres[e].double().tolist()):
            for n, (level, (offset, w, h)) in enumerate(zip(LEVELS, table, strict=True)):
                for dv in range(-3, 4):
                    for du in range(-3, 4):
                        u, v = (
                            x * level.scale + level.shift + du,
                            y * level.scale + level.shift + dv,
                        )
                        if not (np.isfinite(u) and np.isfinite(v)):
                            continue
                        u0, v0 = int(np.floor(u)), int(np.floor(v))
                        for a, b in ((0, 0), (1, 0), (0, 1), (1, 1)):
                            c, r = u0 + a, v0 + b
                            if 0 <= c < w and 0 <= r < h:
                                weight = abs(1 - a - (u - u0)) * abs(1 - b - (v - v0))
                                theirs = pyramid.descriptors[j, offset + r * w + c].double()
                                value = weight * float(source[i, p].double() @ theirs)
                                out[e, p, n, dv + 3, du + 3] += value / CHANNELS**0.5
    return out.reshape(*centres.shape[:2], -1)


def test_the_sampled_windows_equal_loops(problem):
    found = correlation_windows_reference(*problem)
    expected = reference(*problem)
    finite = torch.isfinite(problem[3]).all(-1)
    torch.testing.assert_close(found[finite].double(), expected[finite], atol=1e-3, rtol=1e-4)
    assert expected.abs().max() > 1


def test_the_compiled_windows_equal_the_sampled(problem):
    found, expected = correlation_windows(*problem), reference(*problem).float()
    torch.testing.assert_close(found, expected, atol=2e-4, rtol=1e-4)


@pytest.mark.parametrize("where", ["emulated", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_the_kernels_equal_the_sampled_windows_and_their_gradients(problem, where, monkeypatch):
    if where == "emulated":
        use_emulator(monkeypatch, lookup)
    elif not torch.cuda.is_available():
        pytest.skip("needs a CUDA GPU")
    device = torch.device("cpu" if where == "emulated" else "cuda")
    source, pyramid, edges, centres = problem
    centres = centres.nan_to_num(-500.0)
    expected_leaves = source.clone().requires_grad_(), pyramid.descriptors.clone().requires_grad_()
    expected = correlation_windows_reference(
        expected_leaves[0], DescriptorPyramid(expected_leaves[1], LEVELS), edges, centres
    )
    leaves = [x.detach().clone().to(device).requires_grad_() for x in expected_leaves]
    moved = Edges(edges.first.to(device), edges.second.to(device))
    found = lookup._CudaWindows.apply(
        *leaves, DescriptorPyramid(leaves[1], LEVELS), moved, centres.to(device)
    )
    torch.testing.assert_close(found.cpu(), expected, atol=2e-3, rtol=1e-3)
    grad = torch.randn(expected.shape, generator=torch.Generator().manual_seed(4))
    expected.backward(grad)
    found.backward(grad.to(device))
    for mine, theirs in zip(leaves, expected_leaves, strict=True):
        torch.testing.assert_close(mine.grad.cpu(), theirs.grad, atol=3e-3, rtol=1e-3)
        assert theirs.grad.abs().max() > 0.5


# --- the volume of DROID-SLAM ------------------------------------------------------------------


def features(height: int = 11, width: int = 18, depth: int = 12, batch: int = 2) -> list:
    n = batch * depth * height * width
    values = torch.arange(n, dtype=torch.float32)
    return [torch.sin(k * values).reshape(batch, depth, height, width) for k in (0.37, 0.91)]


def positions(height: int = 11, width: int = 18, batch: int = 2) -> torch.Tensor:
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    coords = torch.stack([u, v], -1).float()[None].repeat(batch, 1, 1, 1)
    return coords + 6 * torch.sin(torch.arange(coords.numel()).reshape(coords.shape) * 0.7)


def bilinear(image: torch.Tensor, x: float, y: float) -> float:
    """Zero beyond the border, integer pixel centres; written for reading."""
    height, width = image.shape
    total = 0.0
    for row in range(height):
        for column in range(width):
            weight = max(0.0, 1 - abs(x - column)) * max(0.0, 1 - abs(y - row))
            total += weight * float(image[row, column])
    return total


def test_channels_are_level_then_x_then_y():
    first, second = features()
    coords = positions()
    radius, levels, side = 3, 4, 7
    found = CorrelationVolume(first, second)(coords)
    assert found.shape == (2, levels * side * side, 11, 18)
    for b, row, column in ((0, 0, 0), (1, 5, 9), (1, 10, 17), (0, 3, 16)):
        products = torch.einsum("d,dhw->hw", first[b, :, row, column], second[b]) / 16
        for level in range(levels):
            image = torch.nn.functional.avg_pool2d(products[None], 2**level)[0]
            x, y = (float(c) / 2**level for c in coords[b, row, column])
            for i, j in ((1, 1), (1, 5), (4, 2), (3, 3)):
                channel = (level * side + i) * side + j
                wanted = bilinear(image, x + i - radius, y + j - radius)
                assert float(found[b, channel, row, column]) == pytest.approx(wanted, abs=1e-5)


def test_far_away_and_not_a_number_are_zero():
    first, second = features()
    coords = positions()
    coords[0, 0, 0] = torch.tensor([1e9, -1e9])
    coords[0, 0, 1] = torch.nan
    found = CorrelationVolume(first, second)(coords)
    assert bool(torch.isfinite(found).all())
    assert float(found[0, :, 0, :2].abs().max()) == 0.0
    assert float(found[0, :, 1, :2].abs().max()) > 0.02


def test_maps_smaller_than_the_pyramid_have_empty_levels():
    first, second = features(4, 5)
    found = CorrelationVolume(first, second)(positions(4, 5))
    assert found.shape == (2, 196, 4, 5)
    assert float(found[:, 147:].abs().max()) == 0.0
    assert float(found[:, 98:147].abs().max()) > 0.002


def test_gradients_reach_both_features():
    first, second = (f.requires_grad_() for f in features(6, 7, 4, 1))
    CorrelationVolume(first, second)(positions(6, 7, 1)).square().sum().backward()
    assert float(first.grad.abs().max()) > 0.01
    assert float(second.grad.abs().max()) > 0.01
