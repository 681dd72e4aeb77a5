"""What several stretches of a video say of the focal length together."""

import math
from dataclasses import replace

import pytest

from geogs.geometry.camera import Camera
from geogs.tracking.calibration.focal_uncertainty import LEAST_DEVIATION, Estimate, joined

CAMERA = Camera(300.0, 310.0, 159.5, 119.5, 320, 240)


def said(focal: float, deviation: float, k1: float = 0.0) -> Estimate:
    camera = replace(CAMERA, fx=focal, fy=focal * CAMERA.fy / CAMERA.fx)
    return Estimate(camera, k1, deviation, 0.1 * deviation, 12)


def test_one_stretch_says_what_it_says():
    found = joined([said(290.0, 0.04, -0.1)])
    assert found.camera.fx == pytest.approx(290.0)
    assert (found.k1, found.deviation, found.keyframes) == (-0.1, pytest.approx(0.04), 12)


def test_two_that_agree_are_joined_by_their_variances():
    found = joined([said(300.0, 0.02), said(309.0, 0.04)])
    a, b = math.log(300.0), math.log(309.0)
    assert found.log_focal == pytest.approx((4 * a + b) / 5)
    assert found.deviation == pytest.approx(1 / math.sqrt(0.02**-2 + 0.04**-2))
    assert found.camera.fy / found.camera.fx == pytest.approx(CAMERA.fy / CAMERA.fx)
    assert found.keyframes == 24


def test_two_that_contradict_each_other_are_as_unsure_as_they_differ():
    found = joined([said(300.0, 0.01), said(90.0, 0.01)])
    assert found.deviation > 0.5


def test_the_party_that_agrees_outvotes_one_that_is_wrong_with_confidence():
    found = joined([said(300.0, 0.03), said(90.0, 0.005), said(303.0, 0.03)])
    assert 300 < found.camera.fx < 303
    assert found.deviation == pytest.approx(0.03 / math.sqrt(2))
    assert found.keyframes == 24


def test_agreement_that_is_too_good_leaves_the_least_deviation():
    assert joined([said(300.0, 0.0021)] * 9).deviation == LEAST_DEVIATION


def test_the_distortion_is_that_of_the_surest():
    found = joined([said(300.0, 0.03, -0.2), said(301.0, 0.01, -0.1)])
    assert (found.k1, found.deviation_k1) == (-0.1, 0.001)
