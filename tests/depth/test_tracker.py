"""The tracker's own depth, enlarged: against a slow loop, and where it is valid."""

import numpy as np
import pytest
import torch

from depth_scene import RENDER, WORKING, make_scene
from geogs.config import DepthConfig, MappingConfig, ReconstructConfig
from geogs.depth.depth_engine import DepthTask
from geogs.depth.depth_view import PosedDepth
from geogs.depth.engine_choice import depth_engine
from geogs.depth.tracker_depth import TrackerDepthEngine, enlarged_depth
from geogs.errors import InputError
from geogs.reconstruction import Reconstruction
from geogs.world.grid import OFFSET, STRIDE


def slow_pixel(view, u: int, v: int) -> float | None:
    """Inverse depth at a pixel of the render; none where less than half of the weight is valid."""
    grid, information = view.inverse_depth, view.information
    x = ((u - RENDER.cx) * WORKING.fx / RENDER.fx + WORKING.cx - OFFSET) / STRIDE
    y = ((v - RENDER.cy) * WORKING.fy / RENDER.fy + WORKING.cy - OFFSET) / STRIDE
    total = share = 0.0
    for i in (int(np.floor(x)), int(np.floor(x)) + 1):
        for j in (int(np.floor(y)), int(np.floor(y)) + 1):
            weight = (1 - abs(x - i)) * (1 - abs(y - j))
            column, row = np.clip(i, 0, grid.shape[1] - 1), np.clip(j, 0, grid.shape[0] - 1)
            d, known = grid[row, column], information[row, column]
            if 1 / (d * np.sqrt(known)) < 0.3:
                total, share = total + weight * d, share + weight
    return total / share if share > 0.5 else None


def test_every_pixel_is_the_mean_of_the_valid_cells_around_it():
    view = make_scene().views[0]
    depth = enlarged_depth(view.inverse_depth, view.information, WORKING, RENDER)
    assert set(np.unique(depth.confidence)) == {0.0, 1.0}
    assert (depth.depth > 0).all()
    checked = 0
    for v in range(0, RENDER.height, 5):
        for u in range(0, RENDER.width, 5):
            expected = slow_pixel(view, u, v)
            assert (expected is not None) == (depth.confidence[v, u] > 0)
            if expected is not None:
                # OpenCV interpolates in steps of a 32nd.
                assert 1 / depth.depth[v, u] == pytest.approx(expected, rel=0.02)
                checked += 1
    assert checked > 150


def test_the_engine_searches_nothing_and_leaves_depths_alone():
    scene = make_scene()
    engine = depth_engine("cpu", RENDER, WORKING, DepthConfig(engine="tracker"), 8)
    assert isinstance(engine, TrackerDepthEngine)
    (dense,) = engine.estimate([DepthTask(scene.views[0], scene.views[1:])])
    sure = dense.confidence > 0
    error = (dense.depth / torch.from_numpy(scene.truth[0]) - 1).abs()
    assert error[sure].median() < 0.03
    assert dense.typical == pytest.approx(float(dense.depth[sure].median()), rel=1e-3)
    posed = [PosedDepth(v.T_cw, dense) for v in scene.views[:2]]
    assert engine.check(posed[:1], [posed[1:]])[0] is dense


def test_known_poses_have_no_tracker():
    config = ReconstructConfig(mapping=MappingConfig(depth=DepthConfig(engine="tracker")))
    with pytest.raises(InputError, match="needs a tracker"):
        Reconstruction(WORKING, config)
