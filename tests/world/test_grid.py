"""The sample grid."""

import pytest
import torch

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.world.grid import SampleGrid

CAMERA = Camera(fx=90.0, fy=95.0, cx=50.0, cy=37.5, width=101, height=77)


def linear_field(pixels: torch.Tensor) -> torch.Tensor:
    return torch.stack([0.3 * pixels[:, 0] - 2, 0.1 * pixels[:, 1] + 0.2 * pixels[:, 0]], -1)


def test_cells_sit_where_the_convention_says():
    grid = SampleGrid(CAMERA)
    assert (grid.width, grid.height) == (len(range(4, 98, 8)), len(range(4, 74, 8)))
    image = torch.stack(torch.meshgrid(torch.arange(77), torch.arange(101), indexing="ij"), -1)
    expected = image[4:-3:8, 4:-3:8].reshape(-1, 2).flip(-1).float()
    torch.testing.assert_close(grid.pixels, expected)
    pixels, z = CAMERA.project(grid.rays)
    torch.testing.assert_close(pixels, grid.pixels)
    assert torch.equal(z, torch.ones_like(z))


@pytest.mark.parametrize(("width", "height"), [(1, 1), (8, 200), (200, 31)])
def test_an_image_with_too_few_cells_is_refused(width: int, height: int) -> None:
    with pytest.raises(InputError, match=f"{width} x {height} pixels; tracking needs at least"):
        SampleGrid(Camera(9.0, 9.0, 0.5, 0.5, width, height))


def test_linear_fields_are_interpolated_exactly():
    grid = SampleGrid(CAMERA)
    field = linear_field(grid.pixels)
    points = torch.tensor([[4.0, 4.0], [10.5, 33.25], [60.0, 59.0], [84.0, 60.0]])
    torch.testing.assert_close(grid.sample_field(field, points), linear_field(points))
    outside = grid.sample_field(field, torch.tensor([[-50.0, 20.0]]))
    torch.testing.assert_close(outside, linear_field(torch.tensor([[4.0, 20.0]])))


def test_cells_of_rounds_to_the_nearest_and_flags_the_rest():
    grid = SampleGrid(CAMERA)
    index, valid = grid.cells_of(grid.pixels + torch.tensor([3.0, -3.0]))
    assert valid.all()
    assert torch.equal(index, torch.arange(grid.size))
    strange = torch.tensor([[-10.0, 5.0], [1e9, 5.0], [float("nan"), 5.0], [50.0, 200.0]])
    assert not grid.cells_of(strange)[1].any()


def test_an_enlarged_field_is_that_of_the_nearest_cell():
    grid = SampleGrid(CAMERA)
    values = torch.arange(grid.size)
    image = grid.enlarged(values, 50, 38)
    assert image.shape == (38, 50)
    v, u = torch.meshgrid(torch.arange(38), torch.arange(50), indexing="ij")
    at = torch.stack([(u + 0.5) * 101 / 50 - 0.5, (v + 0.5) * 77 / 38 - 0.5], -1).reshape(-1, 2)
    distance = torch.cdist(at, grid.pixels)
    expected = distance.gather(1, image.reshape(-1, 1))[:, 0]
    torch.testing.assert_close(expected, distance.min(1).values)
