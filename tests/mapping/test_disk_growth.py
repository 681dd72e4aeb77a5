"""Where disks are made: which pixels are candidates."""

import pytest
import torch

from geogs.mapping.disk_growth import spread_candidates


def test_candidates_are_closer_together_at_edges() -> None:
    needed, at_edge = torch.ones(60, 80, dtype=torch.bool), torch.zeros(60, 80, dtype=torch.bool)
    needed[:10], at_edge[:, 34:46] = False, True
    random = torch.Generator().manual_seed(0)
    v, u, spacing = spread_candidates(needed, at_edge, 6, 2, random)
    near = (u >= 34) & (u < 46)
    assert torch.equal(spacing, torch.where(near, 2, 6))
    assert int(near.sum()) == 25 * 6  # every second row and column
    # One in every cell of 6 x 6 pixels; jitter takes some of them across the borders.
    assert abs(int((~near).sum()) - 50 * 68 / 36) < 15
    assert int(v.min()) >= 10


@pytest.mark.parametrize("edge_stride", [6, 50])
def test_candidates_at_edges_are_no_farther_apart_than_others(edge_stride: int) -> None:
    mask = torch.ones(30, 30, dtype=torch.bool)
    random = torch.Generator().manual_seed(0)
    *_, spacing = spread_candidates(mask, mask, 6, edge_stride, random)
    assert spacing.tolist() == [6] * 25
