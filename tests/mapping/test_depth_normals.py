"""Normals that come with a keyframe's depth: which count, and that they are stored with it."""

from dataclasses import replace

import numpy as np
import torch

from geogs.config import LossConfig
from geogs.depth.depth_engine import DepthEngine, silent
from geogs.depth.depth_view import DenseDepth, KeyframeDepth
from geogs.geometry.camera import Camera
from geogs.mapping.keyframe_depths import KeyframeDepths
from geogs.mapping.view_arrays import MapCameras
from geogs.world.keyframes import Keyframe
from keyframe_samples import Sample, segment_of, views_of

WORKING = Camera(80.0, 80.0, 47.5, 35.5, 96, 72)
CAMERAS = MapCameras(WORKING, WORKING.with_long_edge(48), WORKING)
SIZE = (36, 48)


def keyframes(resident: int = 8) -> list[Keyframe]:
    image = np.random.default_rng(0).integers(0, 255, (72, 96, 3), np.uint8)
    pose = torch.eye(4, dtype=torch.float64)
    return list(segment_of([Sample(i, image, pose) for i in range(3)], WORKING, resident=resident))


def depth_with(normal: torch.Tensor | None) -> DenseDepth:
    plain = DenseDepth.of(
        KeyframeDepth(np.full(SIZE, 2.0, np.float32), np.full(SIZE, 0.5, np.float32))
    )
    return replace(plain, normal=normal)


def facing() -> torch.Tensor:
    return torch.tensor([0.0, 0.0, -1.0]).expand(*SIZE, 3).contiguous()


def test_they_reach_the_losses_and_come_back_from_the_archive():
    made = keyframes(resident=1)
    pool = views_of(made[0].table, CAMERAS, LossConfig())
    for keyframe in made[:2]:
        pool.add(keyframe.id)
        pool[keyframe.id].set_depth(depth_with(facing()))
    assert made[0].id not in pool.arrays.loaded
    for keyframe in made[:2]:
        constants = pool[keyframe.id].constants
        assert torch.equal(constants.prior_normal, facing())


def test_a_depth_without_normals_takes_them_away():
    (keyframe, *_) = keyframes()
    pool = views_of(keyframe.table, CAMERAS, LossConfig())
    pool.add(keyframe.id)
    pool[keyframe.id].set_depth(depth_with(facing()))
    assert pool[keyframe.id].constants.prior_normal is not None
    pool[keyframe.id].set_depth(depth_with(None))
    assert pool[keyframe.id].constants.prior_normal is None


class Sees(DepthEngine):
    """An engine whose depths come with normals."""

    def estimate(self, tasks, progress=silent):
        return [depth_with(facing()) for _ in tasks]


def test_those_of_the_search_are_left_out():
    made = keyframes()
    pool = views_of(made[0].table, CAMERAS, LossConfig())
    views = [pool.add(keyframe.id) for keyframe in made]
    KeyframeDepths(Sees(), pool, None, bare_planes=False).estimate(views)
    assert all(view.dense.normal is None for view in views)
    assert all(view.constants.prior_normal is None for view in views)


def test_those_of_a_prior_come_first():
    (keyframe, *_) = keyframes()
    turned = torch.tensor([0.0, -0.6, -0.8])
    keyframe.prior_normal = turned.expand(72, 96, 3).half()
    pool = views_of(keyframe.table, CAMERAS, LossConfig())
    pool.add(keyframe.id)
    pool[keyframe.id].set_depth(depth_with(facing()))
    found = pool[keyframe.id].constants.prior_normal
    torch.testing.assert_close(found, turned.expand(*SIZE, 3), rtol=0, atol=2e-3)


def test_scaling_and_masking_a_depth_leaves_them():
    depth = depth_with(facing())
    mask = torch.zeros(SIZE, dtype=torch.bool)
    mask[:, 5:] = True
    for changed in (depth.scaled(2.0), depth.within(mask)):
        assert changed.normal is depth.normal
