"""The depth network's losses against loops and integrals, and where their minima are."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.integrate import quad

from depth_tuples import NETWORK, random_views
from geogs.depth.network.model import DepthNetwork
from geogs_train.depth.depth_loss import (
    CELL_SPREAD,
    CHOICE,
    angular,
    choice_loss,
    depth_loss,
    from_either,
    gradient_loss,
    outlier_laplace,
    plane_loss,
    spread_around,
    surfaces_of_cells,
)
from geogs_train.depth.depth_options import DepthLossOptions
from geogs_train.depth.depth_tuples import DepthBatch


def test_the_likelihood_is_a_density_over_errors():
    scale, outlier, log_range = 0.05, 0.2, math.log(10.0)
    logit = torch.tensor(math.log(outlier / (1 - outlier)))

    def density(error: float) -> float:
        e, s = torch.tensor(error), torch.tensor(math.log(scale))
        return float((-outlier_laplace(e, s, logit, torch.tensor(log_range))).exp())

    wanted = 0.8 * math.exp(-0.03 / scale) / (2 * scale) + 0.2 / log_range
    assert density(0.03) == pytest.approx(wanted, rel=1e-4)
    inside, _ = quad(lambda e: density(e) - 0.2 / log_range, -2, 2, points=[0])
    assert inside == pytest.approx(0.8, abs=1e-3)


def test_the_density_of_angles_integrates_to_a_constant():
    """Up to the constant left out, for any concentration: over the sphere."""
    totals = []
    for k in (0.5, 3.0, 40.0):
        value, _ = quad(
            lambda a, k=k: (
                math.sin(a)
                * math.exp(-float(angular(torch.tensor(a), torch.tensor(k, dtype=torch.float64))))
            ),
            0,
            math.pi,
        )
        totals.append(value)
    assert totals[0] == pytest.approx(totals[1], rel=1e-4)
    assert totals[2] == pytest.approx(totals[1], rel=1e-4)


def test_surfaces_of_cells_equal_a_loop():
    rng = torch.Generator().manual_seed(3)
    log_depth = 0.02 * torch.rand(1, 8, 12, generator=rng)
    log_depth[0, 4:, 6:] += 1.0
    valid = torch.ones(1, 8, 12, dtype=torch.bool)
    valid[0, 1, 9] = False
    nearest, farthest, known = surfaces_of_cells(log_depth, valid, 4)
    kinds = set()
    for i in range(2):
        for j in range(3):
            cell = log_depth[0, 4 * i : 4 * i + 4, 4 * j : 4 * j + 4]
            one = bool(cell.max() - cell.min() < CELL_SPREAD)
            sound = bool(valid[0, 4 * i : 4 * i + 4, 4 * j : 4 * j + 4].all())
            kinds.add((one, sound))
            mean = float(cell.mean())
            low, high = (mean, mean) if one else (float(cell.min()), float(cell.max()))
            assert float(nearest[0, i, j]) == pytest.approx(low, abs=1e-6)
            assert float(farthest[0, i, j]) == pytest.approx(high, abs=1e-6)
            assert bool(known[0, i, j]) == sound
    assert kinds == {(True, True), (False, True), (True, False)}


def test_at_an_edge_either_surface_is_right_and_their_mean_is_not():
    found = torch.tensor([[[0.1, 0.5, 0.9, 1.0]]])
    error = from_either(found, torch.full_like(found, 0.1), torch.full_like(found, 0.9))
    assert error[0, 0].tolist() == pytest.approx([0.0, 0.4, 0.0, 0.1], abs=1e-6)


def test_the_spread_around_pixels_equals_a_loop():
    rng = torch.Generator().manual_seed(6)
    depth, valid = torch.rand(1, 7, 9, generator=rng), torch.rand(1, 7, 9, generator=rng) < 0.5
    found = spread_around(depth, valid, 2)
    for i in range(7):
        for j in range(9):
            window = (0, slice(max(i - 2, 0), i + 3), slice(max(j - 2, 0), j + 3))
            some = depth[window][valid[window]]
            wanted = float(some.max() - some.min()) if len(some) else -math.inf
            assert float(found[0, i, j]) == pytest.approx(wanted, abs=1e-6)


def test_the_choice_learns_the_depth_that_is_nearest():
    planes = torch.linspace(-0.55, 0.55, 12)[None]
    tried = torch.tensor([-0.3, 0.0, 0.02, 0.6]).reshape(1, 4, 1, 1).expand(1, 4, 16, 16)
    logits = torch.zeros(1, 4, 16, 16, requires_grad=True)
    torch.manual_seed(0)
    found = DepthNetwork(NETWORK)(random_views(1, 2, 32, 32))
    found = replace(found, log_planes=planes, tried=tried, tried_logits=logits)
    truth = torch.full((1, 32, 32), 0.02)
    truth[0, 2, 2] = 0.9  # a cell of two surfaces says nothing
    truth[0, :2, 2:4] = 0.3  # nor does one that nothing tried lies on
    valid = torch.ones(1, 32, 32, dtype=torch.bool)
    weights = [math.exp(-abs(float(z) - 0.02) / 0.1 / CHOICE) for z in tried[0, :, 0, 0]]
    wanted = [w / sum(weights) for w in weights]
    loss = choice_loss(found, truth, valid)
    assert float(loss.detach()) == pytest.approx(math.log(4), rel=1e-5)
    loss.backward()
    for k in range(4):
        slope = float(logits.grad[0, k, 0, 0])
        assert slope == pytest.approx((0.25 - wanted[k]) / 254, rel=1e-3)
    assert logits.grad[0, :, 0, 1].abs().max() == 0
    assert logits.grad[0, :, 1, 1].abs().max() == 0


def test_differences_of_errors_equal_a_loop():
    rng = torch.Generator().manual_seed(4)
    error = torch.randn(1, 11, 10, generator=rng)
    valid = torch.rand(1, 11, 10, generator=rng) < 0.7
    total = 0.0
    for step in (1, 2, 4, 8):
        for down, across in ((0, step), (step, 0)):
            found = [
                abs(float(error[0, y + down, x + across] - error[0, y, x]))
                for y in range(11 - down)
                for x in range(10 - across)
                if valid[0, y, x] and valid[0, y + down, x + across]
            ]
            total += sum(found) / max(len(found), 1)
    assert float(gradient_loss(error, valid)) == pytest.approx(total / 4, rel=1e-5)
    assert float(gradient_loss(error + 3, valid)) == pytest.approx(total / 4, rel=1e-5)


def test_the_cross_entropy_of_planes_equals_a_loop():
    rng = torch.Generator().manual_seed(5)
    logits = torch.randn(1, 5, 2, 2, generator=rng)
    planes = torch.linspace(-1, 1, 5)[None]
    values = torch.tensor([[-0.9, 0.3], [1.0, 1.7]])  # the last is beyond the planes
    truth = values.repeat_interleave(4, 0).repeat_interleave(4, 1)[None]
    total = []
    for i, j in ((0, 0), (0, 1), (1, 0)):
        place = (float(values[i, j]) + 1) / 0.5
        below = min(int(place), 3)
        log = logits[0, :, i, j].log_softmax(0)
        fraction = place - below
        total.append(-(1 - fraction) * float(log[below]) - fraction * float(log[below + 1]))
    found = plane_loss(logits, planes, truth, torch.ones(1, 8, 8, dtype=torch.bool))
    assert float(found) == pytest.approx(sum(total) / 3, rel=1e-5)


def test_in_a_cell_of_two_surfaces_the_planes_of_either_are_right():
    planes = torch.linspace(-1, 1, 5)[None]
    logits = torch.randn(1, 5, 1, 1, generator=torch.Generator().manual_seed(7))
    truth = torch.full((1, 4, 4), -0.5)
    truth[0, :, 2:] = 1.0
    p = logits[0, :, 0, 0].softmax(0)
    found = plane_loss(logits, planes, truth, torch.ones(1, 4, 4, dtype=torch.bool))
    assert float(found) == pytest.approx(-math.log(0.5 * float(p[1] + p[4])), rel=1e-5)


def batch_of(depth: torch.Tensor) -> DepthBatch:
    views = random_views(1, 2, 32, 32)
    normal = torch.tensor([0.0, 0.0, -1.0])[None, :, None, None].expand(1, 3, 32, 32)
    return DepthBatch(views, depth, normal, torch.zeros(1, 2, dtype=torch.long))


def test_what_is_no_depth_counts_nowhere():
    """A hole in the truth changes neither the loss's value there nor any gradient to nan."""
    torch.manual_seed(0)
    network, options = DepthNetwork(NETWORK), DepthLossOptions()
    depth = torch.full((1, 32, 32), 1.5)
    holes = depth.clone()
    holes[:, 5:9, 5:9] = torch.inf
    others = depth.clone()
    others[:, 5:9, 5:9] = 99.0  # beyond what is searched
    batches = [batch_of(d) for d in (holes, others)]
    found = network(batches[0].views)
    first, second = (depth_loss(found, b, options) for b in batches)
    torch.testing.assert_close(first, second)
    first.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())


def test_likelihoods_begin_late_and_move_no_depth():
    torch.manual_seed(0)
    network = DepthNetwork(NETWORK)
    options = DepthLossOptions(
        gradient=0.0, bent=0.0, normal=0.0, planes=0.0, scores=0.0, agreement=0.0, late=0.5
    )
    batch = batch_of(torch.full((1, 32, 32), 1.5))
    found = network(batch.views)
    plain, early, late = (
        depth_loss(found, replace(batch, progress=p), o)
        for p, o in (
            (0.0, replace(options, likelihood=0.0, spread=0.0)),
            (0.4, options),
            (0.6, options),
        )
    )
    assert float(early.detach()) == pytest.approx(float(plain.detach()))
    assert float(late.detach()) != pytest.approx(float(plain.detach()))
    moved = torch.autograd.grad(late - plain, found.log_depth, retain_graph=True)[0]
    assert moved.abs().max() == 0
    assert torch.autograd.grad(late - plain, found.log_scale)[0].abs().max() > 0
