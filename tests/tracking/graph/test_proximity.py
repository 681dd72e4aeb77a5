"""The choice of pairs among many keyframes is that of looking at every pair."""

import numpy as np
import pytest
import torch

import geogs.tracking.graph.proximity as proximity
from geogs.geometry.lie import se3_exp
from geogs.tracking.graph.proximity import (
    LARGEST_ZOOM,
    alike_in_size,
    frame_distances,
    may_overlap,
    proximity_pairs,
)
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable
from planted_walk import SMALL, planted_tracker


def scattered(count: int, seed: int = 0) -> KeyframeSet:
    """Cameras anywhere, looking anywhere, with depths that vary from cell to cell."""
    grid, g = SampleGrid(SMALL), torch.Generator().manual_seed(seed)
    store = KeyframeTable.on(grid).new_set()
    turn = torch.tensor([2, 2, 2, 0.5, 1.5, 0.5], dtype=torch.float64)
    T = se3_exp(turn * torch.randn(count, 6, generator=g, dtype=torch.float64))
    for n in range(count):
        state = store.add(n, n / 3, np.zeros((4, 4, 3), np.uint8), None, T[n])
        depth = 1 + 4 * torch.rand(1, generator=g) + torch.rand(grid.size, generator=g)
        state.inverse_depth = 1 / depth
    return store


def test_no_pair_within_reach_is_left_out():
    for store in (scattered(60), planted_tracker(80)[0].keyframes):
        ids = store.ids
        may = may_overlap(store, ids, ids, 0.2)
        may &= may.T
        directed = [(i, j) for i in ids for j in ids]
        distance = frame_distances(store, directed).reshape(len(ids), len(ids)).numpy()
        finite = np.isfinite(distance + distance.T)
        assert not (finite & ~may).any()
        # It is a help, too: most of what it lets through can be seen.
        assert finite.sum() > 0.4 * may.sum()
    short = scattered(60)
    assert may_overlap(short, short.ids, short.ids, 0.2).mean() < 0.5


def test_keyframes_that_are_skipped_as_a_whole_have_no_tile_in_view():
    for store in (scattered(60), planted_tracker(200)[0].keyframes):
        ids = store.ids
        spheres = proximity._spheres(store, ids)
        planes = proximity._view_planes(store.grid.camera, store.poses(ids))
        seen = spheres.reach(*planes).float() @ spheres.fraction
        expected = (seen > 0.2 - 1e-6).numpy()
        assert np.array_equal(may_overlap(store, ids, ids, 0.2), expected)
        assert may_overlap(store, ids, ids, 0.0).all()
        skipped = ~spheres.around().reach(*planes)[..., 0]
        assert float(skipped.float().mean()) > 0.05
        assert not (skipped & (seen > 0)).any()


def test_pairs_of_many_keyframes_are_those_of_looking_at_all(monkeypatch):
    store = planted_tracker(90)[0].keyframes
    ids = store.ids
    arguments = (store, ids, ids, [(0, 9), (20, 60)], 3, 3, 40.0, 700)
    fast = proximity_pairs(*arguments)
    monkeypatch.setattr(proximity, "PAIRS_TOGETHER", (10**9, 10**9))
    assert proximity_pairs(*arguments) == fast
    far = [(i, j) for i, j in fast if j - i > 60]
    assert len(far) > 10  # the way back sees the way out
    position_apart = {abs(i - a) + abs(j - b) for i, j in far for a, b in far if (a, b) != (i, j)}
    assert min(position_apart) == 4


def face_to_face(count: int, apart: float, depth: float) -> KeyframeSet:
    """Two rows of cameras in one line that look towards each other, half a unit from one to the
    next, all at the same depth from what they see."""
    grid = SampleGrid(SMALL)
    store = KeyframeTable.on(grid).new_set()
    for n in range(2 * count):
        there = n < count
        T_wc = torch.diag(torch.tensor([1.0, 1, 1, 1] if there else [-1.0, 1, -1, 1]).double())
        T_wc[2, 3] = 0.5 * n if there else 0.5 * (2 * count - 1) + apart - 0.5 * (n - count)
        state = store.add(n, n / 3, np.zeros((4, 4, 3), np.uint8), None, torch.linalg.inv(T_wc))
        state.inverse_depth = torch.full((grid.size,), 1 / depth)
    return store


def test_what_is_seen_from_rooms_away_is_not_matched():
    store, limit = face_to_face(20, apart=12.0, depth=2.0), 60.0
    ids = store.ids
    there, back = ids[:20], ids[20:]
    both = frame_distances(store, [(i, j) for i in there for j in back])
    both += frame_distances(store, [(j, i) for i in there for j in back])
    # The motion alone is small enough, as what is far ahead moves little.
    assert float((both / 2 < limit).float().mean()) > 0.9
    assert not alike_in_size(store, there, back).any()
    # Of those in a row what the one sees is as far from the other as it says.
    gap = 0.5 * np.abs(np.subtract.outer(there, there))
    zoom = np.stack([gap + 2, np.abs(gap - 2)]) / 2
    expected = ((zoom <= LARGEST_ZOOM) & (zoom >= 1 / LARGEST_ZOOM)).all(0)
    clear = (np.abs(np.abs(np.log(zoom + 1e-9)) - np.log(LARGEST_ZOOM)) > 1e-3).all(0)
    assert np.array_equal(alike_in_size(store, there, there)[clear], expected[clear])
    pairs = proximity_pairs(store, ids, ids, [], 1, 0, limit, 10**4)
    assert {(i, j) for i, j in pairs if i < 20 <= j} == {(19, 20)}  # neighbours in time


@pytest.mark.parametrize("count", [40, 90])
def test_the_last_keyframe_finds_its_neighbours(count):
    store = planted_tracker(count)[0].keyframes
    ids = store.ids
    pairs = proximity_pairs(store, [ids[-1]], ids[-25:-1], [], 3, 1, 40.0, 5)
    assert pairs[:3] == [(ids[-1] - k, ids[-1]) for k in (1, 2, 3)]
    assert len(pairs) == 5
    assert all(j == ids[-1] for _, j in pairs)
