"""Robust kernels: what a residual counts is how fast its cost grows with its square."""

import numpy as np
import pytest
import torch

from geogs.geometry.robust import (
    cauchy_cost,
    cauchy_weight,
    geman_mcclure_weight,
    huber_cost,
    huber_weight,
)

KERNELS = {
    "huber": (lambda s: huber_cost(s, 1.3), lambda s: huber_weight(s.sqrt(), 1.3)),
    "cauchy": (cauchy_cost, cauchy_weight),
    "geman_mcclure": (lambda s: s / (1 + s), geman_mcclure_weight),
}


@pytest.mark.parametrize("name", KERNELS)
def test_a_weight_is_the_slope_of_its_cost(name):
    cost, weight = KERNELS[name]
    square = torch.tensor(np.geomspace(1e-3, 100, 40), requires_grad=True)
    (slope,) = torch.autograd.grad(cost(square).sum(), square)
    np.testing.assert_allclose(slope.numpy(), weight(square).detach().numpy(), rtol=1e-9)
