"""Robust kernels (weights and costs of residuals) and a weighted median, for NumPy and PyTorch.

Weights multiply the squares of reweighted least squares. A ``square`` is the squared ratio of a
residual to the kernel's scale.
"""

from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

A = TypeVar("A", Tensor, np.ndarray)


def huber_weight(norm: Float[Tensor, "*n"], knee: float) -> Float[Tensor, "*n"]:
    """Return Huber's weight ``min(1, knee / norm)``."""
    return knee / norm.clamp(min=knee)


def huber_cost(square: Float[Tensor, "*n"], knee: float) -> Float[Tensor, "*n"]:
    """Return Huber's cost of squared residuals: unchanged up to the knee, linear beyond."""
    return torch.where(square > knee**2, 2 * knee * square.sqrt() - knee**2, square)


def cauchy_weight(square: A) -> A:
    """Return Cauchy's weight ``1 / (1 + square)``."""
    return 1 / (1 + square)


def cauchy_cost(square: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return Cauchy's cost ``log(1 + square)``."""
    return torch.log1p(square)


def geman_mcclure_weight(square: A) -> A:
    """Return Geman and McClure's weight ``1 / (1 + square)^2``."""
    return 1 / (1 + square) ** 2


def weighted_median(values: Float[Tensor, "n"], weights: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Return the least value up to which lies half of the weight, of at least one value."""
    order = values.argsort()
    below = weights[order].cumsum(0)
    return values[order[int(torch.searchsorted(below, below[-1] / 2).clamp(max=len(values) - 1))]]
