"""Fields on the sample grid: holes are filled from around them."""

import pytest
import torch

from bundle_scenes import CAMERA
from geogs.bundle.fields import GridFields
from geogs.world.grid import SampleGrid


def test_fill_keeps_known_values_and_bridges_holes():
    grid = SampleGrid(CAMERA)
    fields = GridFields(grid)
    values = 1 + 0.01 * grid.pixels[:, 0]
    known = torch.ones(grid.size)
    known[25:28] = 0
    filled = fields.fill(torch.where(known > 0, values, torch.tensor(99.0)), known)
    torch.testing.assert_close(filled[known > 0], values[known > 0])
    assert float((filled - values).abs().max()) < 0.15
    assert float(fields.fill(values, 0 * known)[0]) == pytest.approx(float(values.mean()))
    one = torch.zeros(grid.size)
    one[40] = 1.0
    torch.testing.assert_close(fields.fill(values, one), torch.full_like(values, float(values[40])))
