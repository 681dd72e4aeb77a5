"""Nearest neighbours."""

import torch

from geogs.geometry.neighbors import nearest_neighbors


def test_nearest_neighbors_agree_with_all_pairs():
    g = torch.Generator().manual_seed(5)
    points, queries = torch.rand(200, 3, generator=g), torch.rand(30, 3, generator=g)
    d, i = nearest_neighbors(queries, points, 4)
    full = torch.cdist(queries.double(), points.double())
    expected, index = full.topk(4, largest=False)
    assert (d - expected.float()).abs().max() < 1e-6
    assert (i == index).all()
    assert nearest_neighbors(queries, points[:3], 5)[0].shape == (30, 3)
