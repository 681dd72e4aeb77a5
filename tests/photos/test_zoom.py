"""A video in which somebody zooms is none of one lens."""

import cv2
import numpy as np
import pytest

from geogs.application.structure_from_motion.chosen_frames import ChosenFrames
from geogs.types import Frame
from geogs_photos.video import place_frames
from posed_layouts import render_room


def zoomed(image: np.ndarray, factor: float) -> np.ndarray:
    """The middle of an image, as large as it was."""
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0.0, factor)
    return cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_CUBIC)


@pytest.mark.system
@pytest.mark.parametrize(
    ("last", "is_known"), [pytest.param(1.0, True, marks=pytest.mark.long), (1.5, False)]
)
def test_frames_of_a_zoom_have_no_place_that_counts(last, is_known):
    pytest.importorskip("pycolmap")
    room = render_room(14, 3, 240, 180)
    factors = np.where(np.arange(14) < 7, 1.0, last)
    images = [zoomed(image, f) for image, f in zip(room.images, factors, strict=True)]
    frames = tuple(Frame(k, k / 10, image) for k, image in enumerate(images))
    chosen = ChosenFrames(frames, np.arange(14) / 10)
    placed = place_frames(chosen, room.camera, False, False, False, 0, lambda *_: None)
    assert len(placed.numbers) >= 12
    assert np.isfinite(placed.deviation).all() == is_known
