"""A flow operator that masks out what is black in an image."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from geogs.config import Config, TrackingConfig
from geogs.tracking.flow.masked import MaskedFlow
from geogs.tracking.flow.operator_choice import build_operator
from geogs.tracking.tracker import lone_tracker
from geogs.world.grid import STRIDE, SampleGrid
from tracking_runs import CONFIG, error_cm
from tracking_scenes import CAMERA, frames, pose, render, sideways

ARM = cv2.resize(
    np.random.default_rng(1).integers(0, 255, (30, 14, 3), np.uint8),
    (84, 144),
    interpolation=cv2.INTER_CUBIC,
)


def with_arm(image: np.ndarray, left: int, paint: bool) -> np.ndarray:
    """The image behind a textured thing that moves with the camera, or black in its place."""
    image = np.maximum(image, 1)
    image[:, left : left + 84] = 0 if paint else ARM
    return image


def test_nothing_is_matched_from_or_to_what_is_black():
    grid = SampleGrid(CAMERA)
    plain = build_operator(TrackingConfig(operator="classical"), grid)
    flow = MaskedFlow(plain, grid)
    images = [
        with_arm(render(pose(x))[0], left, True) for x, left in ((0.0, 60), (0.15, 30), (0.2, 0))
    ]
    first, second, third = (flow.encode(image) for image in images)
    there, back = flow.measure([first, first], [second, third])
    x = grid.pixels[:, 0]
    for n, left in enumerate((30, 0)):
        used = there.weight[n, :, 0] > 0
        assert int(used.sum()) > 20
        assert not bool((used & (x > 60 - STRIDE) & (x < 144 + STRIDE)).any())
        to = there.pixels[n, used, 0]
        assert not bool(((to > left) & (to < left + 83)).any())
        assert not bool((back.weight[n, :, 0] > 0)[(x > left) & (x < left + 83)].any())
    before, _ = plain.measure([first.encoded], [second.encoded])
    assert torch.equal(there.pixels[0], before.pixels[0])
    assert flow.texture(first) <= float(first.valid.cells.mean()) < 0.6


@pytest.mark.long
@pytest.mark.system
def test_an_arm_that_moves_with_the_camera_does_no_harm_where_it_is_black():
    path = sideways(24)
    found = {}
    for paint in (False, True):
        grid = SampleGrid(CAMERA)
        operator = build_operator(CONFIG, grid)
        tracker = lone_tracker(
            CAMERA,
            Config(tracking=CONFIG),
            operator=MaskedFlow(operator, grid) if paint else operator,
        )
        for frame in frames(path):
            left = 60 + round(20 * np.sin(0.5 * frame.index))
            tracker.track(replace(frame, image=with_arm(frame.image, left, paint)))
        tracker.finish()
        trajectory = tracker.trajectory()
        found[paint] = error_cm(trajectory.T_wc[:, :3, 3], np.stack(path)[:, :3, 3])
    assert found[True] < 0.5
    assert found[False] > 3 * found[True]
