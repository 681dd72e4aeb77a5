"""A fused Adam step of the visible rows of a parameter."""

import math

import numba
import torch


def adam_rows(
    p: torch.Tensor,
    grad: torch.Tensor,
    first: torch.Tensor,
    second: torch.Tensor,
    visible: torch.Tensor,
    steps: torch.Tensor,
    corrections: tuple[torch.Tensor, torch.Tensor],
    rate: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Step the visible rows in place by Adam, with bias ``corrections`` by each row's own count of
    ``steps``; float32 on the CPU, as ``tests/oracles/adam_reference.py``."""
    n = len(p)
    width = p[0].numel() if n else 1
    x, g, m, v = (t.detach().reshape(n, width).numpy() for t in (p, grad, first, second))
    c1, c2 = (c.numpy() for c in corrections)
    _adam(x, g, m, v, visible.numpy(), steps.numpy(), c1, c2, rate, betas[0], betas[1], eps)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _adam(p, grad, first, second, visible, steps, corrections1, corrections2, rate, b1, b2, eps):
    beta1 = numba.float32(b1)
    beta2 = numba.float32(b2)
    epsilon = numba.float32(eps)
    new1, new2 = numba.float32(1 - b1), numba.float32(1 - b2)
    for i in range(p.shape[0]):
        if not visible[i]:
            continue
        c1 = corrections1[min(steps[i], corrections1.shape[0] - 1)]
        c2 = corrections2[min(steps[i], corrections2.shape[0] - 1)]
        pace = numba.float32(rate / c1)
        shrink = numba.float32(1 / math.sqrt(c2))
        for k in range(p.shape[1]):
            g = grad[i, k]
            m = beta1 * first[i, k] + new1 * g
            v = beta2 * second[i, k] + new2 * g * g
            first[i, k] = m
            second[i, k] = v
            p[i, k] -= pace * m / (math.sqrt(v) * shrink + epsilon)
