"""Map from the tangent of a similarity to its translation: the costliest part of the logarithm."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

Numbers = tuple[Tensor, Tensor, Tensor]
"""Factors of I, K and K^2."""


class TranslationMap:
    """V with translation = V tau: the integral of exp(s (sigma I + K)) over s in [0, 1], K the
    cross product with phi.

    As K^3 = -theta^2 K, all such matrices are a I + b K + c K^2, stored as three numbers each.
    """

    def __init__(self, phi: Float[Tensor, "*b 3"], sigma: Float[Tensor, "*b"]) -> None:
        self._phi, self._square = phi, phi.square().sum(-1)
        halvings = halvings_of((self._square.sqrt() + sigma.abs()).detach())
        zero, one = torch.zeros_like(sigma), torch.ones_like(sigma)
        h: Numbers = (sigma / 2**halvings, one / 2**halvings, zero)
        term: Numbers = (one, zero, zero)
        v: Numbers = (one, zero, zero)
        for k in range(2, 13):
            a, b, c = self._product(term, h)
            term = a / k, b / k, c / k
            v = v[0] + term[0], v[1] + term[1], v[2] + term[2]
        a, b, c = self._product(h, v)
        e: Numbers = (a + 1, b, c)
        for _ in range(halvings):
            a, b, c = self._product((e[0] + 1, e[1], e[2]), v)
            v, e = (a / 2, b / 2, c / 2), self._product(e, e)
        self._v = v

    def __matmul__(self, tau: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Return V tau."""
        return self._apply(self._v, tau)

    def solve(self, t: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Return V^-1 t."""
        a, b, c = self._v
        p = a - self._square * c
        determinant = p.square() + self._square * b.square()
        inverse = 1 / a, -b / determinant, (b.square() - c * p) / (a * determinant)
        return self._apply(inverse, t)

    def _product(self, x: Numbers, y: Numbers) -> Numbers:
        (a, b, c), (d, e, f) = x, y
        return (
            a * d,
            a * e + b * d - self._square * (b * f + c * e),
            a * f + c * d + b * e - self._square * (c * f),
        )

    def _apply(self, x: Numbers, tau: Tensor) -> Tensor:
        a, b, c = (k[..., None] for k in x)
        once = torch.linalg.cross(*torch.broadcast_tensors(self._phi, tau))
        twice = torch.linalg.cross(*torch.broadcast_tensors(self._phi, once))
        return a * tau + b * once + c * twice


def halvings_of(size: Tensor) -> int:
    """Return how often matrices of these sizes are halved before summing their series."""
    most = float(size.max()) if size.numel() else 0.0
    return max(0, math.ceil(math.log2(most / 0.5))) if 0.5 < most < math.inf else 0
