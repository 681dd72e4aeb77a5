"""Something that fills the view for a moment while a map is started."""

from dataclasses import replace

import numpy as np
import pytest

from geogs.config import Config
from geogs.tracking import local_mapping
from geogs.tracking.start import initialise
from geogs.tracking.tracker import lone_tracker
from geogs.types import Frame
from tracking_runs import CONFIG, error_cm
from tracking_scenes import CAMERA, pose, render, sideways

PATH = sideways(14, step=0.06)
PACE = 0.45
"""Metres to the left by which the thing moves from image to image."""
HALF = 1.14
"""Metres from its middle to its sides: it fills three fifths of an image."""


def crossed() -> list[np.ndarray]:
    """Images along the path, before which a thing moves from right to left: a strip of a wall in a
    world of its own."""
    images = []
    for k, T in enumerate(PATH):
        image = render(T)[0]
        there = pose(PACE * (k - 7), 0.1, -0.2, 0.02 * k)
        thing, depth = render(pose(0.0, 0.3, -0.5, 0.3) @ there)
        x = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx * depth + there[0, 3]
        image[np.abs(x) < HALF] = thing[np.abs(x) < HALF]
        images.append(image)
    return images


def tracked() -> tuple[list[int], float]:
    """Frames that have a place, and their error in centimetres; a start takes 12 keyframes."""
    tracker = lone_tracker(CAMERA, Config(tracking=replace(CONFIG, init_keyframes=12)))
    for k, image in enumerate(crossed()):
        tracker.track(Frame(k, k / 5, image))
    found = tracker.trajectory()
    placed = [k for k, state in enumerate(found.states) if state == "tracked"]
    if not placed:
        return placed, np.inf
    truth = np.stack(PATH)[placed]
    return placed, error_cm(found.T_wc[placed, :3, 3], truth[:, :3, 3])


@pytest.mark.system
def test_a_start_is_made_from_what_one_structure_holds():
    placed, error = tracked()
    assert placed[:6] == [0, 1, 2, 3, 4, 5]
    assert error < 0.4


@pytest.mark.long
@pytest.mark.system
def test_without_asking_what_holds_them_together_none_has_its_place(
    monkeypatch: pytest.MonkeyPatch,
):
    """None at all, or all, and most a wrong one: what the other test looks at is hard."""
    for module in (initialise, local_mapping):
        monkeypatch.setattr(module, "largest_part", lambda keyframes, *_: frozenset(keyframes.ids))
    assert tracked()[1] > 2
