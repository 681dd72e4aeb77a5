"""Frames that do not come at one pace."""

import numpy as np
import torch

from geogs.geometry.lie import se3_exp
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from geogs.world.segments import LastFrame
from tracking_scenes import CAMERA


def test_the_motion_goes_on_for_as_long_as_it_takes():
    segment = KeyframeTable.on(SampleGrid(CAMERA)).new_set()
    black, eye = np.zeros((144, 192, 3), np.uint8), torch.eye(4, dtype=torch.float64)
    keyframe = segment.add(0, 0.0, black, None, eye)
    step = torch.tensor([0.1, 0, 0.02, 0, 0.05, 0], dtype=torch.float64)
    here = LastFrame(keyframe.id, se3_exp(step), se3_exp(step), 1.0, 1.0, 1 / 30)
    for frames_later, expected in ((1.1, 1.0), (2.0, 2.0), (0.5, 0.5), (90.0, 3.0), (-1.0, 0.0)):
        found = here.predicted(keyframe, 1.0 + frames_later / 30)
        torch.testing.assert_close(found, se3_exp((1 + expected) * step), rtol=0, atol=1e-12)
    still = LastFrame(keyframe.id, se3_exp(step), None, 1.0, 1.0, 0.0)
    assert torch.equal(still.predicted(keyframe, 2.0), se3_exp(step))
