"""Features matched between unlike views, and the dense flow that starts from them."""

import numpy as np
import pytest
import torch

from geogs.geometry.lie import se3_inverse
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.matching.sparse_features import (
    MIN_DENSE,
    guided_flow,
    match_features,
    spread_positions,
)
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from tracking_scenes import CAMERA, pose, render

HERE, AHEAD = pose(0.0), pose(0.2, 0.0, 0.9, 0.05)
"""Ahead, half of what is still seen has moved by more than 24 of 192 pixels."""


def truth_at(points: torch.Tensor, T_wc: np.ndarray) -> torch.Tensor:
    """Where a camera sees what the one of ``HERE`` has at some pixels."""
    depth = render(HERE)[1]
    x, y = points.double().unbind(-1)
    z = torch.from_numpy(depth)[y.round().long(), x.round().long()]
    rays = torch.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, x * 0 + 1], -1)
    T = se3_inverse(torch.from_numpy(T_wc)) @ torch.from_numpy(HERE)
    X = (rays * z[:, None]) @ T[:3, :3].mT + T[:3, 3]
    return torch.stack(
        [CAMERA.fx * X[:, 0] / X[:, 2] + CAMERA.cx, CAMERA.fy * X[:, 1] / X[:, 2] + CAMERA.cy], -1
    )


def grey(T_wc: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(render(T_wc)[0][..., 0]).float()


def right_share(match: FlowMatch) -> float:
    """Share of the matched cells that are within two pixels of the truth."""
    pixels = SampleGrid(CAMERA).pixels
    error = (match.pixels[0] - truth_at(pixels, AHEAD)).norm(dim=-1)
    return float((error[match.weight[0, :, 0] > 0] < 2).double().mean())


def test_features_are_found_again_after_a_long_way_ahead() -> None:
    found = match_features(grey(HERE), grey(AHEAD))
    assert found is not None
    assert len(found) > 120
    motion = (found.second - found.first).norm(dim=-1)
    assert float(motion.quantile(0.9)) > 30
    error = (found.second - truth_at(found.first, AHEAD)).norm(dim=-1)
    assert float((error < 2).double().mean()) > 0.9
    assert float(error.median()) < 0.5


def test_images_of_nothing_in_common_have_no_matches() -> None:
    behind = pose(0.0, yaw=np.pi)
    assert match_features(grey(HERE), grey(behind)) is None
    assert match_features(grey(HERE), torch.full_like(grey(HERE), 90.0)) is None
    for seed in range(3):
        noise = np.random.default_rng(seed).integers(0, 255, (2, 144, 192)).astype(np.float32)
        first, second = torch.from_numpy(noise)
        assert match_features(first, second) is None
        assert match_features(grey(HERE), second) is None


def test_cells_go_where_the_features_around_them_go() -> None:
    grid = SampleGrid(CAMERA)
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(60, 2, generator=generator) * torch.tensor([190.0, 142.0])
    shift = torch.tensor([31.0, -7.0])
    torch.testing.assert_close(spread_positions(grid, points, points + shift), grid.pixels + shift)
    # Two features in one cell count by their mean.
    two = grid.pixels[[30, 30]] + torch.tensor([[1.0, 0], [-1, 0]])
    moved = two + torch.tensor([[10.0, 0], [20, 0]])
    cells = spread_positions(grid, torch.cat([points, two]), torch.cat([points + shift, moved]))
    near = (points - grid.pixels[30]).abs().amax(dim=1) < 4
    count = int(near.sum())
    expected = (torch.tensor([30.0, 0]) + count * shift) / (2 + count)
    torch.testing.assert_close(cells[30], grid.pixels[30] + expected)


def test_flow_that_lost_its_way_starts_from_features() -> None:
    grid = SampleGrid(CAMERA)
    operator = ClassicalFlow(grid)
    first, second = (operator.encode(render(T)[0]) for T in (HERE, AHEAD))
    cold = operator.measure([first], [second], fine=False)
    there, back = guided_flow(grid, operator, first, second, *cold)
    assert right_share(cold[0]) < 0.65
    assert right_share(there) > 0.85
    matched, before = ((m.weight[0, :, 0] > 0).sum() for m in (there, cold[0]))
    assert int(matched) > 1.5 * int(before)
    assert int((back.weight[0, :, 0] > 0).sum()) > 1.5 * int(before)


def test_flow_that_is_sure_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = SampleGrid(CAMERA)
    operator = ClassicalFlow(grid)
    first, second = (operator.encode(render(T)[0]) for T in (HERE, pose(0.03)))
    cold = operator.measure([first], [second], fine=False)
    assert float((cold[0].weight > 0).double().mean()) > MIN_DENSE
    # No feature is looked for, which would take longer than the flow.
    monkeypatch.setattr("geogs.tracking.matching.sparse_features.match_features", None)
    there, back = guided_flow(grid, operator, first, second, *cold)
    assert there is cold[0]
    assert back is cold[1]
