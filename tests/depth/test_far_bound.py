"""The sky has no depth, and what parallax tells from infinity keeps its own."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from depth_scene import RENDER, WORKING, make_scene
from geogs.depth.classical import CpuDepthEngine
from geogs.depth.depth_view import DenseDepth, DepthView, KeyframeDepth
from geogs.depth.far_bound import LEAST_SHIFT, BoundedSearch, shift_from_infinity


def _moved(x: float, z: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, 0, z
    return T


def _pixel(x: np.ndarray) -> np.ndarray:
    return np.array([x[0] / x[2] * RENDER.fx + RENDER.cx, x[1] / x[2] * RENDER.fy + RENDER.cy])


class _Told(CpuDepthEngine):
    """An engine that finds what it was told."""

    def __init__(self, depth: np.ndarray) -> None:
        super().__init__(RENDER, WORKING, 64)
        self.depth = depth

    def estimate(self, references: Sequence[DepthView], *_: object) -> list[DenseDepth]:
        one = KeyframeDepth(self.depth, np.full_like(self.depth, 0.8))
        return [DenseDepth.of(one) for _ in references]


def test_the_shift_is_that_of_points_projected_one_by_one():
    random = np.random.default_rng(2)
    depth = random.uniform(1, 60, (RENDER.height, RENDER.width)).astype(np.float32)
    poses = np.stack([_moved(-0.3, 0.0), _moved(0.1, -0.8)])
    found = shift_from_infinity(torch.from_numpy(depth), poses, RENDER)
    for v, u in ((0, 0), (35, 47), (70, 90), (20, 60)):
        ray = np.array([(u - RENDER.cx) / RENDER.fx, (v - RENDER.cy) / RENDER.fy, 1.0])
        shifts = [0.0]
        for T in poses:
            point = T[:3, :3] @ (depth[v, u] * ray) + T[:3, 3]
            seen, end = (_pixel(x) for x in (point, T[:3, :3] @ ray))
            if 0 <= seen[0] <= RENDER.width - 1 and 0 <= seen[1] <= RENDER.height - 1:
                shifts.append(float(np.linalg.norm(seen - end)))
        assert float(found[v, u]) == pytest.approx(max(shifts), rel=1e-4)


def test_only_what_is_beyond_all_and_as_good_as_infinite_loses_its_confidence():
    scene = make_scene()
    view = replace(scene.views[0], T_cw=np.eye(4))
    aside = replace(scene.views[1], T_cw=_moved(-0.2, 0.0))
    depth = np.full((RENDER.height, RENDER.width), 4.0, np.float32)
    depth[:20], depth[20:40] = 39.0, 28.0
    engine = BoundedSearch(_Told(depth), RENDER, WORKING)
    bounds = 80 * 0.2 / np.array([39.0, 28.0, 4.0]) < LEAST_SHIFT * RENDER.long_edge
    assert bounds.tolist() == [True, True, False]  # what parallax alone says
    (found,) = engine.estimate([view], [[aside]], limits=[(1.0, 40.0)])
    confidence = found.confidence.numpy()
    # From 40 / 1.3 on nobody knows of anything; at 28 the tracker knows a surface.
    assert not confidence[:20, 2:].any()
    assert (confidence[20:] == np.float32(0.8)).all()
    assert np.array_equal(found.depth.numpy(), depth)
    # With ten times the baseline 39 is told from infinity.
    wide = replace(aside, T_cw=_moved(-2.0, 0.0))
    (found,) = engine.estimate([view], [[wide]], limits=[(1.0, 40.0)])
    assert (found.confidence.numpy()[:, 8:] == np.float32(0.8)).all()
    (alone,) = engine.estimate([view], [[]])
    assert (alone.confidence.numpy() == np.float32(0.8)).all()
