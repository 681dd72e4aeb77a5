"""What is made of what a stretch of a video says of focal length and distortion."""

import math

import pytest
import torch

from geogs.geometry.camera import Camera
from geogs.tracking.calibration.self_calibration import Estimate, with_prior

CAMERA = Camera(300.0, 310.0, 159.5, 119.5, 320, 240)


def test_what_is_known_of_lenses_tells_what_a_narrow_view_does_not():
    lens = CAMERA.moved(0.0, 3.0, -40.0)
    root = torch.tensor([[0.05, 0.004, 0], [3.0, 0, 0.1], [-40.0, 0, 3.0]]).double()
    found = with_prior(Estimate(lens, root @ root.mT, 12))
    assert abs(found.lens.k1) < 0.3
    assert abs(found.lens.k2) < 0.6
    assert found.lens.fx == pytest.approx(CAMERA.fx * math.exp(-0.05), rel=0.01)
    assert found.deviation < 0.01


def test_what_is_known_of_lenses_does_not_change_a_pinhole():
    covariance = torch.tensor([0.04**2, 0, 0], dtype=torch.float64).diag()
    found = with_prior(Estimate(CAMERA, covariance, 12))
    assert (found.lens, found.deviation) == (CAMERA, pytest.approx(0.04))
