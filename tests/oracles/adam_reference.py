"""Adam on the visible rows of a parameter in plain PyTorch."""

from torch import Tensor


def adam_reference(
    p: Tensor,
    grad: Tensor,
    first: Tensor,
    second: Tensor,
    visible: Tensor,
    steps: Tensor,
    corrections: tuple[Tensor, Tensor],
    rate: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """One Adam step of the visible rows, in place, as ``splat/cpu/adam.py`` does."""
    g = grad[visible]
    m = first[visible].lerp(g, 1 - betas[0])
    v = second[visible].lerp(g * g, 1 - betas[1])
    first[visible], second[visible] = m, v
    row = (-1,) + (1,) * (p.dim() - 1)
    c1, c2 = (c[steps[visible].clamp(max=len(c) - 1)].view(row).to(p.dtype) for c in corrections)
    p[visible] -= rate * (m / c1) / ((v / c2).sqrt() + eps)
