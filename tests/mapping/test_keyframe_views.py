"""The views around one, against a search view by view."""

import numpy as np
import torch

from geogs.config import Config
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.mapping.view_arrays import MapCameras
from geogs.types import FoundLens
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from keyframe_samples import views_of

CAMERA = Camera(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)


def test_the_nearest_come_in_the_order_in_which_they_were_given():
    random = torch.Generator().manual_seed(1)
    config, store = Config(), KeyframeTable.on(SampleGrid(CAMERA))
    segment = store.new_set()
    cameras = MapCameras.of(CAMERA, config.mapping)
    views, image = views_of(store, cameras, config.mapping.loss), np.zeros((48, 64, 3), np.uint8)
    for id in range(20):
        T = se3_exp(torch.randn(6, generator=random, dtype=torch.float64))
        views.add(segment.add(id, id / 30, image, None, T).id)
        away = [float(np.linalg.norm(v.view_pose.center - views[id].view_pose.center))
                for v in views.values()]  # fmt: skip
        for count in (1, 5, 40):
            nearest = sorted(sorted(range(id + 1), key=lambda n: away[n])[:count])
            assert [v.id for v in views.near(views[id], views, count)] == nearest
    segment[3].T_cw = segment[11].T_cw
    assert [v.id for v in views.near(views[11], views, 2)] == [3, 11]


def test_views_have_the_images_that_took_the_places_of_others():
    config, store = Config(), KeyframeTable.on(SampleGrid(CAMERA))
    segment, cameras = store.new_set(), MapCameras.of(CAMERA, config.mapping)
    views = views_of(store, cameras, config.mapping.loss)
    image = np.random.default_rng(0).integers(1, 255, (48, 64, 3), np.uint8)
    view = views.add(segment.add(0, 0.0, image, None, torch.eye(4, dtype=torch.float64)).id)
    before, segments = view.depth_view.grey.copy(), view.bare_segments
    store.straighten(FoundLens(0.3, 0.1, 0.01, 0.01), {})
    views.arrays.forget_images()
    assert np.array_equal(view.depth_view.image, segment[0].straight_image)
    assert not np.array_equal(view.depth_view.image, image)
    assert not np.array_equal(view.depth_view.grey, before)
    assert view.bare_segments is not segments
