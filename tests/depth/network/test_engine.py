"""The network's depth engine: what it is given, what it makes of it, and the shipped weights."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from depth_scene import RENDER, WORKING, DepthScene, make_scene, trace
from geogs.config import DepthConfig
from geogs.depth.depth_engine import DepthEngine, DepthTask
from geogs.depth.depth_view import PosedDepth
from geogs.depth.engine_choice import depth_engine
from geogs.depth.network import engine as network_engine
from geogs.depth.network.engine import resampled
from geogs.depth.network.search_range import RATIO, search_range
from geogs.geometry.depth_maps import normals_from_depth

CONFIG = DepthConfig(engine="network")


@pytest.fixture(scope="module")
def scene() -> DepthScene:
    return make_scene()


@pytest.fixture(scope="module")
def engine() -> DepthEngine:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(network_engine, "EDGE", 192)
        return depth_engine("cpu", RENDER, WORKING, CONFIG, 8)


@pytest.fixture(scope="module")
def found(scene, engine):
    return engine.estimate([DepthTask(scene.views[0], scene.views[1:4])])[0]


def test_the_shipped_network_finds_depth_and_knows_how_well(scene, found):
    error = np.abs(found.depth.numpy() / scene.truth[0] - 1)
    assert np.median(error) < 0.02
    assert error.mean() < 0.04
    confidence = found.confidence.numpy()
    right = error < 0.02
    # Pixels of one image err together; this one, small and sharp, is better than they say.
    assert -0.4 < confidence.mean() - right.mean() < 0.1
    assert confidence[right].mean() > confidence[~right].mean()
    assert found.typical == pytest.approx(np.median(scene.truth[0]), rel=0.02)


def test_its_normals_are_those_of_the_surface(scene, found):
    T_wc = np.linalg.inv(scene.views[0].T_cw)
    truth = torch.from_numpy(trace(RENDER, T_wc)[0])
    normal, valid = normals_from_depth(truth, RENDER)
    known = valid & (found.normal.norm(dim=-1) > 0.5)
    assert known.float().mean() > 0.5
    cosine = (normal * found.normal).sum(-1)[known]
    assert torch.rad2deg(cosine.clamp(-1, 1).arccos()).median() < 12
    assert torch.allclose(found.normal[known].norm(dim=-1), torch.ones(()), atol=1e-3)


def test_the_unit_of_length_does_not_matter(scene, engine, found):
    scaled = []
    for view in scene.views[:3]:
        T_cw = view.T_cw.copy()
        T_cw[:3, 3] *= 7
        inverse, information = (view.inverse_depth / 7), view.information * 49
        grids = inverse.astype(np.float32), information.astype(np.float32)
        scaled.append(replace(view, T_cw=T_cw, inverse_depth=grids[0], information=grids[1]))
    one = engine.estimate([DepthTask(scene.views[0], scene.views[1:3])])[0]
    other = engine.estimate([DepthTask(scaled[0], scaled[1:])])[0]
    torch.testing.assert_close(7 * one.depth, other.depth, rtol=2e-3, atol=0)


def test_the_check_keeps_normals_and_without_neighbours_the_tracker_remains(scene, engine, found):
    alone = engine.estimate([DepthTask(scene.views[1], [])])[0]
    assert alone.normal is None
    assert alone.confidence.max() <= 0.5
    posed = [PosedDepth(v.T_cw, d) for v, d in zip(scene.views, (found, alone), strict=False)]
    checked = engine.check(posed[:1], [posed[1:]])[0]
    assert checked.normal is found.normal
    assert not torch.equal(checked.confidence, found.confidence)


def test_resampling_equals_a_loop_but_at_edges():
    maps = torch.rand(1, 2, 6, 8) * 0.01
    maps[:, 0, :, 4:] += 1.0
    at = resampled(maps, (3, 5))
    for row in range(3):
        for column in range(5):
            y, x = (row + 0.5) * 6 / 3 - 0.5, (column + 0.5) * 8 / 5 - 0.5
            i, j = int(y), int(x)
            v, u = y - i, x - j
            near = maps[0, :, int((row + 0.5) * 2), int((column + 0.5) * 1.6)]
            corners = maps[0, :, i : i + 2, j : j + 2]
            weight = torch.tensor([[(1 - v) * (1 - u), (1 - v) * u], [v * (1 - u), v * u]])
            smooth = (corners * weight).sum((1, 2))
            wanted = near if abs(smooth[0] - near[0]) > 0.02 else smooth
            torch.testing.assert_close(at[0, :, row, column], wanted)
    assert resampled(maps, (6, 8)) is maps


def test_the_range_is_twice_what_is_seen_within_bounds():
    depth = np.linspace(1.0, 4.0, 1001)
    found = search_range(1 / depth, 1 / depth)
    assert found.near == pytest.approx(0.5 * 1.15, rel=0.01)
    assert found.far == pytest.approx(2 * 3.85, rel=0.01)
    assert found.typical == pytest.approx(2.5, rel=0.01)
    flat = search_range(np.full(20, 0.5), np.full(20, 0.5))
    assert flat.far / flat.near == pytest.approx(RATIO[0])
    assert (flat.far * flat.near) ** 0.5 == pytest.approx(2.0)
    deep = np.geomspace(0.1, 1000, 1001)
    assert search_range(1 / deep, 1 / deep).far / search_range(
        1 / deep, 1 / deep
    ).near == pytest.approx(RATIO[1])
    nothing = np.empty(0)
    assert search_range(nothing, nothing).typical == pytest.approx(1.0)
    said = search_range(1 / depth, nothing, (0.5, 100.0))
    assert (said.near, said.far) == (0.5, 100.0)
