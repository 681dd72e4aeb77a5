"""Looking up correlation: against sampling the volume position by position."""

import pytest
import torch

from geogs.tracking.flow.correlation import CorrelationVolume


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
    radius, levels, side = 2, 3, 5
    found = CorrelationVolume(first, second, levels, radius, 12**-0.5)(coords)
    assert found.shape == (2, levels * side * side, 11, 18)
    for b, row, column in ((0, 0, 0), (1, 5, 9), (1, 10, 17), (0, 3, 16)):
        products = torch.einsum("d,dhw->hw", first[b, :, row, column], second[b]) / 12**0.5
        for level in range(levels):
            image = torch.nn.functional.avg_pool2d(products[None], 2**level)[0]
            x, y = (float(c) / 2**level for c in coords[b, row, column])
            for i, j in ((0, 0), (0, 4), (3, 1), (2, 2)):
                channel = (level * side + i) * side + j
                wanted = bilinear(image, x + i - radius, y + j - radius)
                assert float(found[b, channel, row, column]) == pytest.approx(wanted, abs=1e-5)


def test_scale_is_a_factor():
    first, second = features()
    plain = CorrelationVolume(first, second, 2, 1, 1.0)(positions())
    torch.testing.assert_close(
        CorrelationVolume(first, second, 2, 1, 1 / 16)(positions()), plain / 16, atol=1e-6, rtol=0
    )


def test_far_away_and_not_a_number_are_zero():
    first, second = features()
    coords = positions()
    coords[0, 0, 0] = torch.tensor([1e9, -1e9])
    coords[0, 0, 1] = torch.nan
    found = CorrelationVolume(first, second, 3, 2, 12**-0.5)(coords)
    assert bool(torch.isfinite(found).all())
    assert float(found[0, :, 0, :2].abs().max()) == 0.0
    assert float(found[0, :, 1, :2].abs().max()) > 0.1


def test_maps_smaller_than_the_pyramid_have_empty_levels():
    first, second = features(4, 5)
    found = CorrelationVolume(first, second, 4, 1, 12**-0.5)(positions(4, 5))
    assert found.shape == (2, 36, 4, 5)
    assert float(found[:, 27:].abs().max()) == 0.0
    assert float(found[:, 18:27].abs().max()) > 0.01


def test_gradients_reach_both_features():
    first, second = (f.requires_grad_() for f in features(6, 7, 4, 1))
    CorrelationVolume(first, second, 2, 1, 0.5)(positions(6, 7, 1)).square().sum().backward()
    assert float(first.grad.abs().max()) > 0.1
    assert float(second.grad.abs().max()) > 0.1
