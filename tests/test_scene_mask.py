"""Which pixels of a keyframe may show the scene, also where images were straightened."""

import numpy as np
import torch

from geogs.camera.straight_view import StraightView
from geogs.geometry.camera import Camera
from geogs.scene_mask import SceneMask
from geogs.types import FoundLens
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeTable

CAMERA = Camera(fx=110.0, fy=110.0, cx=79.5, cy=59.5, width=160, height=120)
WIDE = FoundLens(0.1, 0.1, 0.001, 0.001)
"""It shows the rim farther out than the pinhole, and so does not show all that this does."""


def keyframe(image: np.ndarray, lens: FoundLens | None) -> Keyframe:
    keyframes = KeyframeTable.on(SampleGrid(CAMERA)).new_set()
    keyframes.table.lens = lens
    return keyframes.add(0, 0.0, image, None, torch.eye(4, dtype=torch.float64))


def test_what_a_lens_did_not_see_is_masked_out():
    grey, seen = np.full((120, 160, 3), 90, np.uint8), StraightView(CAMERA, CAMERA, WIDE).is_seen
    assert SceneMask().of(keyframe(grey, None)) is None
    assert np.array_equal(SceneMask().of(keyframe(grey, WIDE)), seen)
    assert SceneMask().of(keyframe(grey, FoundLens(-0.1, 0.0, 0.001, 0.001))) is None


def test_a_mask_is_straightened_as_images_are():
    grey, fixed = np.full((120, 160, 3), 90, np.uint8), np.ones((120, 160), bool)
    fixed[90:, 20:60] = False
    view = StraightView(CAMERA, CAMERA, WIDE)
    assert np.array_equal(SceneMask(fixed).of(keyframe(grey, None)), fixed)
    valid = SceneMask(fixed).of(keyframe(grey, WIDE))
    assert np.array_equal(valid, view.is_seen & view.nearest(fixed))
    assert int((valid != (fixed & view.is_seen)).sum()) > 20
    black = grey.copy()
    black[:10] = 0
    straight = view.image(black)
    both = SceneMask(fixed, True).of(keyframe(black, WIDE))
    assert np.array_equal(both, valid & (straight.max(-1) > 0))
    assert int((both != valid).sum()) > 100
