"""L_1, SSIM and NCC: against slow loops and scikit-image, invariances, gradients, masks."""

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from geogs.losses.kernel_settings import NCC_VARIANCE_FLOOR
from oracles.photometric_reference import ncc, robust_l1, ssim


def images(seed: int, *shape: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    a = torch.from_numpy(rng.random(shape))
    return a, (a + 0.2 * torch.from_numpy(rng.random(shape) - 0.5)).clamp(0, 1)


def test_robust_l1_by_hand() -> None:
    zero = torch.zeros(1, 4, dtype=torch.float64)
    difference = torch.tensor([[0.01, -0.1, 0.5, 0.3]], dtype=torch.float64)
    mask = torch.tensor([[True, True, True, False]])
    plain, _ = robust_l1(zero, difference, mask)
    torch.testing.assert_close(plain, torch.tensor([[0.01, 0.1, 0.5, 0.0]]).double())
    difference.requires_grad_()
    loss, _ = robust_l1(zero, difference, mask, huber=0.02, cut=0.2)
    expected = torch.tensor([[0.01**2 / 0.04, 0.1 - 0.01, 0.2 - 0.01, 0.0]])
    torch.testing.assert_close(loss.detach(), expected.double())
    loss.sum().backward()
    torch.testing.assert_close(difference.grad, torch.tensor([[0.5, -1.0, 0.0, 0.0]]).double())


def test_colour_is_the_mean_over_channels() -> None:
    a, b = images(0, 20, 22, 3)
    mask = torch.ones(20, 22, dtype=torch.bool)
    for term in (robust_l1, ncc, ssim):
        together, _ = term(a, b, mask)
        apart = torch.stack([term(a[..., c], b[..., c], mask)[0] for c in range(3)]).mean(0)
        torch.testing.assert_close(together, apart)


def test_ncc_matches_a_slow_loop() -> None:
    a, b = images(1, 16, 18)
    mask = torch.from_numpy(np.random.default_rng(2).random((16, 18)) > 0.2)
    loss, used = ncc(a, b, mask, patch=5, reject=3.0, min_variance=0.07, min_coverage=0.75)
    filled = torch.where(mask, b, a)
    count = 0
    for y in range(16):
        for x in range(18):
            inside = 2 <= y < 14 and 2 <= x < 16
            if not inside:
                assert not used[y, x]
                continue
            window = slice(y - 2, y + 3), slice(x - 2, x + 3)
            p, q = a[window].numpy().ravel(), filled[window].numpy().ravel()
            if mask[window].double().mean() < 0.75 or p.var() <= 0.07:
                assert not used[y, x]
                assert loss[y, x] == 0
                continue
            count += 1
            deviation = np.sqrt((p.var() + NCC_VARIANCE_FLOOR) * (q.var() + NCC_VARIANCE_FLOOR))
            correlation = ((p - p.mean()) * (q - q.mean())).mean() / deviation
            assert float(loss[y, x]) == pytest.approx(1 - correlation, abs=1e-9)
    assert 20 < count < 150


def test_ncc_ignores_gain_and_offset_but_not_the_sign() -> None:
    a, _ = images(3, 20, 20)
    mask = torch.ones(20, 20, dtype=torch.bool)
    same, used = ncc(a, 0.4 * a + 0.3, mask)
    assert used[3:-3, 3:-3].all()
    assert same.max() < 2e-3  # what the variance floor leaves
    opposite, used = ncc(a, 1 - a, mask)
    assert not used.any()
    assert (opposite == 0).all()
    kept, used = ncc(a, 1 - a, mask, reject=2.5)
    torch.testing.assert_close(kept[used], torch.full_like(kept[used], 2.0), atol=1e-3, rtol=0)


def test_ssim_matches_scikit_image_where_the_window_is_full() -> None:
    a, b = images(4, 40, 44)
    loss, used = ssim(a, b, torch.ones(40, 44, dtype=torch.bool))
    _, expected = structural_similarity(
        a.numpy(), b.numpy(), data_range=1.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    assert used[5:-5, 5:-5].all()
    inner = (1 - loss).numpy()[5:-5, 5:-5]
    np.testing.assert_allclose(inner, expected[5:-5, 5:-5], atol=1e-10)


def test_masked_pixels_are_not_seen() -> None:
    a, b = images(5, 24, 24)
    mask = torch.ones(24, 24, dtype=torch.bool)
    mask[:, 15:] = False
    spoiled = torch.where(mask, b, torch.full_like(b, float("nan")))
    for term in (robust_l1, ncc, ssim):
        torch.testing.assert_close(term(a, spoiled, mask), term(a, b, mask))
        loss, used = term(a, b, torch.zeros_like(mask))
        assert not used.any()
        assert (loss == 0).all()


@pytest.mark.parametrize("term", [robust_l1, ncc, ssim])
def test_gradients_match_finite_differences(term) -> None:  # type: ignore[no-untyped-def]
    a, b = images(6, 13, 14)
    mask = torch.from_numpy(np.random.default_rng(7).random((13, 14)) > 0.1)
    b.requires_grad_()

    def total(x: torch.Tensor) -> torch.Tensor:
        loss, _ = term(a, x, mask)
        return (loss * torch.linspace(0.5, 1.5, loss.numel()).view_as(loss)).sum()

    assert torch.autograd.gradcheck(total, b, eps=1e-7, atol=1e-6, rtol=1e-4, fast_mode=True)
    flat = torch.full_like(b, 0.5).detach().requires_grad_()
    loss, _ = term(flat.detach(), flat, mask)
    loss.sum().backward()
    assert torch.isfinite(flat.grad).all()
