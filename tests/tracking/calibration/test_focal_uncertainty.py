"""What several stretches of a video say of focal length and distortion together."""

import math
from dataclasses import replace

import pytest
import torch

from geogs.bundle.lens import RadialLens
from geogs.geometry.camera import Camera
from geogs.tracking.calibration.focal_uncertainty import LEAST_DEVIATION, Estimate, joined

CAMERA = Camera(300.0, 310.0, 159.5, 119.5, 320, 240)


def said(focal: float, deviation: float) -> Estimate:
    """Of a pinhole."""
    camera = replace(CAMERA, fx=focal, fy=focal * CAMERA.fy / CAMERA.fx)
    covariance = torch.tensor([deviation**2, 0, 0], dtype=torch.float64).diag()
    return Estimate(RadialLens(camera), covariance, 12)


def test_one_stretch_says_what_it_says():
    found = joined([said(290.0, 0.04)])
    assert found.camera.fx == pytest.approx(290.0)
    assert (found.lens.k1, found.deviation, found.keyframes) == (0.0, pytest.approx(0.04), 12)


def test_two_that_agree_are_joined_by_their_variances():
    found = joined([said(300.0, 0.02), said(309.0, 0.04)])
    a, b = math.log(300.0), math.log(309.0)
    assert math.log(found.camera.fx) == pytest.approx((4 * a + b) / 5)
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


def of_lens(truth: torch.Tensor, root: torch.Tensor, seed: int) -> Estimate:
    """An estimate whose errors are as its covariance says, ``root`` times unit noise."""
    noise = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return Estimate(RadialLens(CAMERA), root @ root.mT, 12).moved(
        truth + root @ noise, root @ root.mT, 12
    )


def test_sizes_that_lean_on_each_other_are_joined_by_their_covariances():
    truth = torch.tensor([math.log(300.0), -0.2, 0.05], dtype=torch.float64)
    root = torch.tensor([[0.04, 0, 0], [0.03, 0.001, 0], [-0.02, 0.001, 0.001]]).double()
    other = torch.tensor([[0.04, 0, 0], [-0.03, 0.001, 0], [0.02, 0.001, 0.001]]).double()
    found = joined([of_lens(truth, root, 0), of_lens(truth, other, 1)])
    assert found.deviation < 0.01  # each alone is four times as unsure
    assert bool(((found.sizes - truth).abs() < 3 * found.covariance.diagonal().sqrt()).all())


def test_a_lens_is_a_pinhole_where_matches_do_not_tell_that_it_bends():
    root = torch.tensor([[0.03, 0.005, 0], [0.02, 0, 0.001], [0, 0.001, 0.02]]).double()
    bent = Estimate(RadialLens(CAMERA, 0.04, -0.02), root @ root.mT, 12)
    found = bent.as_told()
    assert (found.lens.k1, found.lens.k2, found.deviations[1:]) == (0, 0, (0, 0))
    shift = math.log(found.camera.fx / CAMERA.fx)
    assert shift == pytest.approx(-0.06, rel=0.05)  # k1 of two deviations takes focal length along
    assert found.deviation == pytest.approx(math.hypot(0.005, shift / 2), rel=0.1)
    clear = Estimate(RadialLens(CAMERA, 0.12, -0.02), root @ root.mT, 12)
    assert clear.as_told() is clear


def test_what_is_known_of_lenses_tells_what_a_narrow_view_does_not():
    lens = RadialLens(CAMERA, 3.0, -40.0)
    root = torch.tensor([[0.05, 0.004, 0], [3.0, 0, 0.1], [-40.0, 0, 3.0]]).double()
    found = joined([Estimate(lens, root @ root.mT, 12)])
    assert abs(found.lens.k1) < 0.3
    assert abs(found.lens.k2) < 0.6
    assert found.camera.fx == pytest.approx(CAMERA.fx * math.exp(-0.05), rel=0.01)
    assert found.deviation < 0.01
