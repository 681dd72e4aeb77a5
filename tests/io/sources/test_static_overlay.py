"""What all images show at the same place while all else in them moves."""

import numpy as np
import pytest

from geogs.io.sources.static_overlay import IMAGES, static_overlay
from moving_wall import seen, with_bonnet

BONNET = np.s_[92:, :]


def test_a_bonnet_is_found_with_what_is_bare_of_it():
    found = static_overlay(with_bonnet(seen(IMAGES)))
    assert found is not None
    assert found[BONNET].mean() > 0.9
    assert found[: 92 - 8].mean() < 0.002


def test_an_image_that_differs_does_not_hide_it():
    images = with_bonnet(seen(IMAGES))
    images[5] = np.zeros_like(images[5])
    found = static_overlay(images)
    assert found is not None
    assert found[BONNET].mean() > 0.9


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_found_where_all_moves(seed):
    assert static_overlay(seen(IMAGES, seed=seed)) is None


def test_nothing_is_found_of_a_camera_that_rests_or_of_few_images():
    assert static_overlay(seen(IMAGES, step=0.0)) is None
    assert static_overlay(with_bonnet(seen(IMAGES, step=0.0))) is None
    assert static_overlay(with_bonnet(seen(7))) is None
    assert static_overlay([]) is None


def test_what_is_bare_alone_is_no_overlay():
    """A sky is the same wherever the camera is."""
    images = seen(IMAGES)
    for image in images:
        image[:40] = 230
    found = static_overlay(images)
    assert found is None or found.mean() < 0.03
