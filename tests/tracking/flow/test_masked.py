"""A flow operator that masks out a part of all images."""

import cv2
import numpy as np
import pytest
import torch

from geogs.config import TrackingConfig
from geogs.errors import InputError
from geogs.loop.orb_features import orb_features
from geogs.tracking.flow.masked import MaskedFlow
from geogs.tracking.flow.operator_choice import build_operator
from geogs.world.grid import STRIDE, SampleGrid
from tracking_scenes import CAMERA, pose, render

MASK = np.ones((144, 192), bool)
MASK[104:] = False


def with_bonnet(image: np.ndarray) -> np.ndarray:
    """The image with a textured thing in its lower part that never moves."""
    bonnet = np.random.default_rng(1).integers(0, 255, (10, 48, 3), np.uint8)
    image = image.copy()
    image[104:] = cv2.resize(bonnet, (192, 40), interpolation=cv2.INTER_CUBIC)
    return image


def test_nothing_is_matched_from_or_to_what_is_masked_out():
    grid = SampleGrid(CAMERA)
    plain = build_operator(TrackingConfig(operator="classical"), grid)
    masked = MaskedFlow(plain, grid, MASK)
    images = [with_bonnet(render(pose(x))[0]) for x in (0.0, 0.15)]
    first, second = ([masked.encode(image)] for image in images)
    before, _ = plain.measure([first[0].encoded], [second[0].encoded])
    after, back = masked.measure(first, second)
    hidden = grid.pixels[:, 1] > 104 - STRIDE
    assert bool((before.weight[0, hidden] > 0).any())
    for match in (after, back):
        assert not match.weight[0, hidden].any()
        used = match.weight[0, :, 0] > 0
        assert float(match.pixels[0, used, 1].max()) < 104
    seen = grid.pixels[:, 1] < 80
    assert torch.equal(after.weight[0, seen], before.weight[0, seen])
    assert torch.equal(after.pixels, before.pixels)
    assert masked.fixed.fraction == pytest.approx(float((~hidden).float().mean()), abs=0.06)
    assert masked.texture(first[0]) <= masked.fixed.fraction


def test_a_mask_has_the_size_of_the_images_and_shows_something():
    grid = SampleGrid(CAMERA)
    plain = build_operator(TrackingConfig(operator="classical"), grid)
    with pytest.raises(InputError, match="mask is 10 x 10 pixels, the images are 192 x 144"):
        MaskedFlow(plain, grid, np.ones((10, 10), bool))
    with pytest.raises(InputError, match="hides the whole image"):
        MaskedFlow(plain, grid, np.zeros((144, 192), bool))


def test_no_features_are_found_where_the_mask_hides():
    image = with_bonnet(render(pose(0.0))[0])
    everywhere, shown = (orb_features(image, m) for m in (None, MASK))
    assert (everywhere.pixels[:, 1] > 106).any()
    assert len(shown) > 20
    assert shown.pixels[:, 1].max() < 106
