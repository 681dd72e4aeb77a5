"""The calibration recovers what errors were drawn with."""

import math

import pytest
import torch

from geogs.depth.network.depth_calibration import TOLERANCE, DepthCalibration, right_logit
from geogs_train.depth.depth_scores import DepthErrors, calibrated, logistic_fit

N = 60_000


def drawn(factor: float, fraction: float = 0.0, seed: int = 0) -> DepthErrors:
    """Laplace errors whose scales are ``factor`` times what is said; some are outliers."""
    rng = torch.Generator().manual_seed(seed)
    scale = 0.002 * (30 * torch.rand(N, generator=rng)).clamp_min(0.5)
    uniform = torch.rand(N, generator=rng).clamp(1e-6, 1 - 1e-6) - 0.5
    error = -factor * scale * uniform.sign() * torch.log1p(-2 * uniform.abs())
    wild = torch.rand(N, generator=rng) < fraction
    error = torch.where(wild, 2 * torch.rand(N, generator=rng) - 1, error)
    said = torch.full((N,), max(fraction, 1e-4))
    return DepthErrors(
        error, 2**0.5 * scale, said, torch.zeros(N), torch.zeros(N, dtype=torch.uint8)
    )


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.6])
def test_the_factor_on_deviations_is_found(factor):
    found = calibrated(drawn(factor))
    assert found.scale == pytest.approx(factor, rel=0.03)
    pixels = drawn(factor, seed=1)
    deviation = found.deviation((pixels.deviation / 2**0.5).log())
    inside = (pixels.error.abs() < 2 * deviation).float().mean()
    assert float(inside) == pytest.approx(1 - math.exp(-2 * 2**0.5), abs=0.005)


def test_confidences_are_the_share_of_what_is_right():
    """Also where deviations are wrong and there are outliers; on other pixels than those fitted."""
    found = calibrated(drawn(1.5, 0.1))
    pixels = drawn(1.5, 0.1, seed=1)
    log_scale = (pixels.deviation / 2**0.5).log()
    confidence = found.confidence(log_scale, torch.logit(pixels.outlier))
    right = (pixels.error.abs() < TOLERANCE).float()
    for low in (0.2, 0.4, 0.6):
        some = (confidence >= low) & (confidence < low + 0.2)
        assert some.sum() > 1000
        assert float(right[some].mean()) == pytest.approx(float(confidence[some].mean()), abs=0.05)


def test_the_logit_is_that_of_the_distribution():
    scale, outlier = 0.015, 0.3
    chance = (1 - outlier) * (1 - math.exp(-TOLERANCE / scale))
    found = right_logit(
        torch.tensor(math.log(scale)), torch.tensor(math.log(outlier / (1 - outlier)))
    )
    assert float(found.sigmoid()) == pytest.approx(chance, rel=1e-5)
    same = DepthCalibration().confidence(
        torch.tensor(math.log(scale)), torch.tensor(math.log(outlier / (1 - outlier)))
    )
    assert float(same) == pytest.approx(chance, rel=1e-5)


def test_the_logistic_fit_is_the_most_likely():
    rng = torch.Generator().manual_seed(2)
    x = 2 * torch.randn(20_000, generator=rng, dtype=torch.float64)
    right = torch.rand(20_000, generator=rng) < (0.7 * x - 0.4).sigmoid()
    gain, offset = logistic_fit(x, right)
    assert gain == pytest.approx(0.7, abs=0.05)
    assert offset == pytest.approx(-0.4, abs=0.05)
