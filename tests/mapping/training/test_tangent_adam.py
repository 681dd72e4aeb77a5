"""Adam on pose tangents against PyTorch's."""

import torch

from geogs.mapping.training.pose_refine import TangentAdam


def test_equals_torch() -> None:
    g = torch.Generator().manual_seed(0)
    a = torch.randn(4, 6, generator=g, dtype=torch.float64).requires_grad_()
    b = a.detach().clone().requires_grad_()
    ours, theirs = TangentAdam(a, 3e-3), torch.optim.Adam([b], lr=3e-3)
    for _ in range(20):
        b.grad = torch.randn(4, 6, generator=g, dtype=torch.float64)
        ours.step(b.grad)
        theirs.step()
    assert torch.allclose(a, b, rtol=0, atol=1e-14)


def test_what_is_not_finite_moves_nothing() -> None:
    x = torch.zeros(2, 6, dtype=torch.float64, requires_grad=True)
    TangentAdam(x, 0.1).step(torch.full_like(x, torch.nan))
    assert (x == 0).all()
