"""A sky with clouds above a wall: its depth is unknown, whatever the search says of it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from depth_scene import RENDER, WORKING, make_scene
from geogs.depth.classical import CpuDepthEngine
from geogs.depth.depth_engine import AlternativeSearch, DepthTask
from geogs.depth.depth_view import DenseDepth, DepthView, KeyframeDepth, depth_images
from geogs.depth.revision.revised_searches import FAR_RATIO, SkySearch, unbounded
from geogs.geometry.camera import Camera

ENGINE = CpuDepthEngine(RENDER, WORKING, 8)
HORIZON = -0.05
"""Of y / z in the world: what is above is sky."""


def slopes(view: DepthView, camera: Camera) -> np.ndarray:
    """(x / z, y / z) of the pixels' rays in the world."""
    rays = camera.rays(torch.float64).numpy() @ view.T_cw[:3, :3]
    return rays[..., :2] / rays[..., 2:]


def is_sky(view: DepthView, camera: Camera) -> np.ndarray:
    return slopes(view, camera)[..., 1] < HORIZON


def clouds(at: np.ndarray) -> np.ndarray:
    """Faint waves of 10 to 40 per radian."""
    rng = np.random.default_rng(3)
    value = np.zeros(at.shape[:2])
    for _ in range(16):
        wave = rng.standard_normal(2)
        value += np.sin(at @ (wave * rng.uniform(10, 40) / np.linalg.norm(wave)))
    return np.repeat((170 + 5 * value)[..., None].clip(0, 255).astype(np.uint8), 3, axis=2)


def under_a_sky(view: DepthView, noise: float) -> DepthView:
    rng = np.random.default_rng(view.id)
    image = np.where(is_sky(view, WORKING)[..., None], clouds(slopes(view, WORKING)), view.image)
    image = (image + noise * rng.standard_normal(image.shape)).clip(0, 255).astype(np.uint8)
    grey, fine = depth_images(image, RENDER)
    return replace(view, image=image, grey=grey, fine=fine)


def outside(noise: float = 2.0) -> tuple[list[DepthView], np.ndarray, np.ndarray]:
    """Views, the first one's depth with a sky at four times its median, and where that is."""
    scene = make_scene()
    views = [under_a_sky(view, noise) for view in scene.views]
    sky = is_sky(views[0], RENDER)
    far = np.float32(4 * np.median(scene.truth[0]))
    return views, np.where(sky, far, scene.truth[0]), sky


def dense(depth: np.ndarray) -> DenseDepth:
    return DenseDepth.of(KeyframeDepth(depth, np.full_like(depth, 0.7)))


def inner(mask: np.ndarray) -> np.ndarray:
    """Without what has the other kind within four pixels."""
    return cv2.erode(mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0


@pytest.mark.parametrize("noise", [0.0, 2.0, 6.0])
def test_a_sky_is_told_from_a_wall(noise):
    views, depth, sky = outside(noise)
    found = unbounded(views[0], views[1:], dense(depth), ENGINE)
    assert found is not None
    found = found.numpy()
    assert found[inner(sky)].mean() > 0.95
    assert found[~sky].mean() < 0.005


def test_a_wall_that_was_found_too_far_away_is_no_sky():
    _, _, sky = outside()
    truth = make_scene().truth[0]
    wrong = np.where(sky, truth, 3 * truth)
    wrong[:, :48] = truth[:, :48]
    views = make_scene().views
    found = unbounded(views[0], views[1:], dense(wrong.astype(np.float32)), ENGINE)
    assert found is None or found.float().mean() < 0.01


def test_where_nothing_is_far_nothing_is_asked():
    views, depth, _ = outside()
    near = np.minimum(depth, 0.99 * FAR_RATIO * np.median(depth)).astype(np.float32)
    assert unbounded(views[0], views[1:], dense(near), ENGINE) is None
    assert unbounded(views[0], [], dense(depth), ENGINE) is None


class Found(AlternativeSearch):
    """A search that finds what it was given."""

    def __init__(self, depth: DenseDepth) -> None:
        super().__init__(ENGINE)
        self.depth = depth

    def estimate(self, tasks, progress=None):
        return [self.depth for _ in tasks]


def test_the_search_is_sure_of_no_sky():
    views, depth, sky = outside()
    normal = torch.zeros(*depth.shape, 3)
    normal[..., 2] = -1
    given = replace(dense(depth), normal=normal)
    (found,) = SkySearch(Found(given)).estimate([DepthTask(views[0], views[1:])])
    unsure = found.confidence == 0
    assert unsure[torch.from_numpy(inner(sky))].float().mean() > 0.95
    assert (found.confidence[~unsure] == given.confidence[~unsure]).all()
    assert (found.depth == given.depth).all()
    assert (found.sky == unsure).all()
    assert (found.normal == normal).all()
