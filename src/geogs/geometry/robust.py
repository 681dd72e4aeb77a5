"""Robust kernels, for arrays of NumPy and of PyTorch: how much a residual counts; and the median by
weight.

Weights multiply the squares of reweighted least squares. A ``square`` is that of a residual over
the deviation at which the kernel bends.
"""

from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

A = TypeVar("A", Tensor, np.ndarray)


def huber_weight(norm: Float[Tensor, "*n"], knee: float) -> Float[Tensor, "*n"]:
    """Huber's weight ``min(1, knee / norm)``."""
    return knee / norm.clamp(min=knee)


def huber_cost(square: Float[Tensor, "*n"], knee: float) -> Float[Tensor, "*n"]:
    """Huber's cost of squared residuals: they themselves up to the knee, linear beyond."""
    return torch.where(square > knee**2, 2 * knee * square.sqrt() - knee**2, square)


def cauchy_weight(square: A) -> A:
    """Cauchy's weight ``1 / (1 + square)``."""
    return 1 / (1 + square)


def cauchy_cost(square: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Cauchy's cost ``log(1 + square)``."""
    return torch.log1p(square)


def geman_mcclure_weight(square: A) -> A:
    """Geman and McClure's weight ``1 / (1 + square)^2``."""
    return 1 / (1 + square) ** 2


def geman_mcclure_cost(square: A) -> A:
    """Geman and McClure's cost ``square / (1 + square)``."""
    return square / (1 + square)


def weighted_median(values: Float[Tensor, "n"], weights: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """The least value up to which lies half of the weight; there is at least one."""
    order = values.argsort()
    below = weights[order].cumsum(0)
    return values[order[int(torch.searchsorted(below, below[-1] / 2).clamp(max=len(values) - 1))]]
