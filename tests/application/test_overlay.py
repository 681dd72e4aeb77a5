"""What all images show at the same place, masked out where nobody gave a mask."""

import cv2
import numpy as np
import pytest

from geogs.application.calibrate import without_overlay
from geogs.config import InputConfig
from geogs.io.sources.sniff import open_source
from io_samples import write_video
from moving_wall import HEIGHT, WIDTH, seen, with_bonnet
from progress_listener import Listener


def coloured(images: list[np.ndarray]) -> list[np.ndarray]:
    return [
        cv2.resize(np.repeat(image[..., None], 3, 2), (2 * WIDTH, 2 * HEIGHT)) for image in images
    ]


def test_a_folder_with_one_is_masked(tmp_path):
    for k, image in enumerate(coloured(with_bonnet(seen(60, 2.0)))):
        cv2.imwrite(str(tmp_path / f"{k:03d}.png"), image)
    config = InputConfig(long_edge=WIDTH)
    opened, listener = open_source(tmp_path, config), Listener()
    source = without_overlay(opened, listener)
    assert len(listener.said) == 1
    assert "masked out" in listener.said[0]
    assert opened.mask is None
    assert source.camera.height == pytest.approx(0.75 * HEIGHT, abs=6)
    assert source.camera.width == WIDTH
    assert source.mask.shape == (source.camera.height, WIDTH)
    assert source.mask[:84].all()
    assert source.with_focal(90.0).mask is not None
    assert next(iter(source)).mask is source.mask
    short = open_source(tmp_path, InputConfig(long_edge=WIDTH, stop=39))
    assert without_overlay(short) is short
    kept = open_source(tmp_path, InputConfig(long_edge=WIDTH, mask_overlay=False))
    assert without_overlay(kept) is kept
    whole = tmp_path.parent / "whole.png"
    cv2.imwrite(str(whole), np.full((2 * HEIGHT, 2 * WIDTH), 255, np.uint8))
    given = open_source(tmp_path, InputConfig(long_edge=WIDTH, mask=whole))
    assert without_overlay(given) is given


def test_a_selection_that_shows_none_has_none(tmp_path):
    for k, image in enumerate(coloured(seen(60, 2.0))):
        cv2.imwrite(str(tmp_path / f"{k:03d}.png"), image)
    source = open_source(tmp_path, InputConfig(long_edge=WIDTH))
    assert without_overlay(source) is source


def test_a_video_with_one_is_masked(tmp_path):
    """Its images are those from which it can be decoded, every twelfth."""
    images = coloured(with_bonnet(seen(200, 2.0)))
    path = write_video(tmp_path / "v.mp4", images, [40 * k for k in range(len(images))])
    source = without_overlay(open_source(path, InputConfig(long_edge=WIDTH)))
    assert source.mask is not None
    assert source.camera.height == pytest.approx(0.75 * HEIGHT, abs=6)
    assert source.mask[:84].all()
