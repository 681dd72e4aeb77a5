"""Views read ahead are those that reading them when they are asked for would give."""

import numpy as np
import torch

from geogs.config import Config
from geogs.depth.depth_view import DenseDepth
from geogs.geometry.camera import Camera
from geogs.mapping.keyframe_views import KeyframeViews
from geogs.mapping.view_arrays import MapCameras
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable
from keyframe_samples import views_of

CAMERA = Camera(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)


def pool_of(count: int, resident: int) -> tuple[KeyframeViews, KeyframeSet]:
    """A pool of views of noise at the depth of their number."""
    random, config = np.random.default_rng(0), Config().mapping
    segment = KeyframeTable.on(SampleGrid(CAMERA), None, resident).new_set()
    cameras = MapCameras.of(CAMERA, config)
    pool = views_of(segment.table, cameras, config.loss)
    for n in range(count):
        image = random.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        pool.add(segment.add(n, n / 30, image, None, torch.eye(4, dtype=torch.float64)).id)
        depth = torch.full((cameras.render.height, cameras.render.width), 1.0 + n)
        pool[n].set_depth(DenseDepth(depth, torch.ones_like(depth), depth.median()))
    return pool, segment


def test_what_was_read_ahead_is_what_is_read_without():
    ahead, _ = pool_of(8, 2)
    plain, _ = pool_of(8, 2)
    ahead.arrays.read_ahead(range(8))
    for n in range(8):
        a, b = ahead.arrays.load(n), plain.arrays.load(n)
        assert torch.equal(a.photo.grey, b.photo.grey)
        assert torch.equal(a.photo.texture, b.photo.texture)
        for name in ("edge", "image_gradient", "prior_depth", "confidence"):
            found, expected = ahead[n].constants, plain[n].constants
            assert torch.equal(getattr(found, name), getattr(expected, name))
    assert sum(n in ahead.arrays.loaded for n in range(8)) == 2


def test_what_has_changed_meanwhile_is_read_again():
    pool, segment = pool_of(6, 2)
    pool.arrays.read_ahead([0, 1, 2])
    segment[0].rescale(2.0)
    depth = torch.full_like(pool.arrays.load(5).depth.depth, 9.0)
    pool[1].set_depth(DenseDepth(depth, torch.ones_like(depth), depth.median()))
    pool[2].set_exposure(torch.tensor([2.0, 0.5, 1e-4]))
    assert float(pool[0].constants.prior_depth[0, 0]) == 2.0
    assert float(pool[1].constants.prior_depth[0, 0]) == 9.0
    light = pool_of(6, 2)[0].arrays.load(2).photo.grey
    torch.testing.assert_close(pool.arrays.load(2).photo.grey, 2 * light + 0.5)
