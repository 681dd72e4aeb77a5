"""Gain and offset between the grey values of two views."""

import numpy as np
import pytest
import torch

from cuda_emulator import use_emulator
from geogs.losses import exposure
from geogs.losses.exposure import (
    LEAST_NOISE,
    USUAL_NOISE,
    noise_between,
    relative_exposure,
    relative_exposure_on_gpu,
)

GPU = pytest.param(
    "cuda",
    marks=[
        pytest.mark.gpu,
        pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"),
    ],
)


def values(random: np.random.Generator, n: int = 2000, spread: float = 0.15) -> torch.Tensor:
    return torch.from_numpy(0.5 + spread * random.standard_normal(n)).float()


def noise(random: np.random.Generator, n: int = 2000) -> torch.Tensor:
    return torch.from_numpy(0.01 * random.standard_normal(n)).float()


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.6, 0.1), (1.7, -0.2)])
def test_hidden_surfaces_do_not_count(gain, offset):
    random = np.random.default_rng(0)
    grey = values(random)
    other = gain * grey + offset + noise(random)
    other[:700] = values(random, 700)  # what hides the surface has grey values of its own
    found = relative_exposure(grey + noise(random), other, torch.ones(2000, dtype=torch.bool))
    assert found.tolist() == pytest.approx([gain, offset], abs=0.02)


def test_noise_is_no_gain_along_a_chain():
    """A plain regression would lose a tenth in 20 steps: the noise is 7 % of the texture."""
    random = np.random.default_rng(1)
    true, gain = values(random), 1.0
    for _ in range(20):
        here, there = true + noise(random), true + noise(random)
        gain *= float(relative_exposure(here, there, torch.ones(2000, dtype=torch.bool))[0])
    assert gain == pytest.approx(1.0, abs=0.02)


def test_a_bare_wall_tells_brightness_only():
    random = np.random.default_rng(2)
    wall = torch.full((2000,), 0.7)
    usable = torch.ones(2000, dtype=torch.bool)
    found = relative_exposure(wall + noise(random), wall - 0.1 + noise(random), usable)
    assert float(found[0]) == pytest.approx(1.0, abs=0.05)
    assert float(found[0]) * 0.7 + float(found[1]) == pytest.approx(0.6, abs=2e-3)


def test_too_few_pixels_say_nothing():
    grey = values(np.random.default_rng(3))
    usable = torch.zeros(2000, dtype=torch.bool)
    usable[:40] = True
    assert relative_exposure(grey, 0.5 * grey, usable).tolist() == [1.0, 0.0]


@pytest.mark.parametrize("device", ["cpu", GPU])
@pytest.mark.parametrize("usable", [0.9, 0.2, 0.01, 0.0])
def test_the_kernel_fits_what_pytorch_fits(device, usable, monkeypatch):
    if device == "cpu":
        use_emulator(monkeypatch, exposure)
        monkeypatch.setattr(exposure, "_THREADS", 64)
    random = np.random.default_rng(5)
    grey = values(random)
    other = 1.4 * grey - 0.1 + noise(random)
    other[:500] = values(random, 500)
    counts = torch.from_numpy(random.random(2000) < usable)
    expected = relative_exposure(grey, other, counts)
    found = relative_exposure_on_gpu(grey.to(device), other.to(device), counts.to(device)).cpu()
    assert found.tolist() == pytest.approx(expected.tolist(), abs=2e-4)
    assert (expected[0] == 1) == (usable <= 0.01)


def test_noise_is_what_differs_where_nothing_else_does():
    """Places with texture are not quite where they should be; of the bare ones some are hidden."""
    random = np.random.default_rng(6)
    true, usable = values(random), torch.ones(2000, dtype=torch.bool)
    texture = torch.linspace(0, 1, 2000)
    here, there = true + noise(random), true + noise(random) + 0.2 * (texture - 0.3).clamp(min=0)
    there[:20] = values(random, 20)
    usable[60:160] = False
    here[60:160] = 0.0
    assert float(noise_between(here, there, texture, usable)) == pytest.approx(0.01**2, rel=0.2)
    assert float(noise_between(true, true, texture, usable)) == pytest.approx(LEAST_NOISE)
    usable[200:] = False
    assert float(noise_between(here, there, texture, usable)) == pytest.approx(USUAL_NOISE)
