"""Views read ahead are those that reading them when they are asked for would give."""

import numpy as np
import torch

from geogs.config import Config
from geogs.depth.view import DenseDepth
from geogs.geometry.camera import Camera
from geogs.mapping.cameras import MapCameras
from geogs.mapping.view_pool import ViewPool
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable

CAMERA = Camera(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)


def pool_of(count: int, resident: int) -> tuple[ViewPool, KeyframeSet]:
    """A pool of views of noise at the depth of their number."""
    random, config = np.random.default_rng(0), Config().mapping
    segment = KeyframeTable.on(SampleGrid(CAMERA)).new_set()
    cameras = MapCameras.of(CAMERA, config)
    pool = ViewPool(cameras, config.loss, torch.device("cpu"), resident)
    for n in range(count):
        image = random.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        pool.add(segment.add(n, n / 30, image, None, torch.eye(4, dtype=torch.float64)))
        depth = torch.full((cameras.render.height, cameras.render.width), 1.0 + n)
        pool.set_depth(n, DenseDepth(depth, torch.ones_like(depth), depth.median()))
    return pool, segment


def test_what_was_read_ahead_is_what_is_read_without():
    ahead, _ = pool_of(8, 2)
    plain, _ = pool_of(8, 2)
    ahead.read_ahead(range(8))
    for n in range(8):
        a, b = ahead.maps(n), plain.maps(n)
        assert torch.equal(a.photo, b.photo)
        for name in ("edge", "image_gradient", "prior_depth", "confidence"):
            found, expected = ahead.constants(n), plain.constants(n)
            assert found is not None
            assert torch.equal(getattr(found, name), getattr(expected, name))
    assert sum(ahead.is_resident(n) for n in range(8)) == 2


def test_what_has_changed_meanwhile_is_read_again():
    pool, segment = pool_of(6, 2)
    pool.read_ahead([0, 1, 2])
    segment[0].rescale(2.0)
    depth = torch.full_like(pool.maps(5).depth.depth, 9.0)
    pool.set_depth(1, DenseDepth(depth, torch.ones_like(depth), depth.median()))
    pool.set_light(2, torch.tensor([2.0, 0.5]))
    assert float(pool.constants(0).prior_depth[0, 0]) == 2.0
    assert float(pool.constants(1).prior_depth[0, 0]) == 9.0
    light = pool_of(6, 2)[0].maps(2).photo
    torch.testing.assert_close(pool.maps(2).photo, 2 * light + 0.5)
