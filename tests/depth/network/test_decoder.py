"""The second search's depths against loops: modes of the planes, what is tried, what is chosen."""

import math

import pytest
import torch

from geogs.depth.network.decoder import CLOSE, COUNT, ONE_SURFACE, chosen, close_depths, plane_modes


def test_modes_equal_a_loop():
    rng = torch.Generator().manual_seed(1)
    logits = 3 * torch.randn(2, 24, 3, 4, generator=rng)
    planes = torch.linspace(-1, 1, 24).expand(2, -1)
    found = plane_modes(logits, planes)
    for b in range(2):
        for i in range(3):
            for j in range(4):
                p = logits[b, :, i, j].softmax(0).tolist()
                first, second, share = modes_by_hand(p, planes[b].tolist())
                assert float(found.first[b, i, j]) == pytest.approx(first, abs=1e-5)
                assert float(found.second[b, i, j]) == pytest.approx(second, abs=1e-4)
                assert float(found.probability[b, i, j]) == pytest.approx(share, abs=1e-5)


def modes_by_hand(p: list[float], planes: list[float]) -> tuple[float, float, float]:
    def peak(q: list[float]) -> int:
        padded = [0.0, *q, 0.0]
        sums = [sum(padded[k : k + 3]) for k in range(len(q))]
        return sums.index(max(sums))

    def mean(q: list[float], at: int) -> tuple[float, float]:
        some = [k for k in range(len(q)) if abs(k - at) <= 2]
        total = sum(q[k] for k in some)
        return sum(q[k] * planes[k] for k in some) / total, total

    first = peak(p)
    rest = [v if abs(k - first) > 3 else 0.0 for k, v in enumerate(p)]
    depth, share = mean(p, first)
    return depth, mean(rest, peak(rest))[0], share


def test_a_mode_is_one_of_two_surfaces_and_not_between_them():
    planes = torch.linspace(0, 2, 41)[None]
    near, far = -((planes - 0.5) ** 2) / 0.002, -((planes - 1.5) ** 2) / 0.002
    logits = torch.logaddexp(near, far + math.log(0.7))
    found = plane_modes(logits[..., None, None], planes)
    assert float(found.first) == pytest.approx(0.5, abs=0.01)
    assert float(found.second) == pytest.approx(1.5, abs=0.01)
    assert float(found.probability) == pytest.approx(1 / 1.7, abs=0.02)


def test_what_is_tried_lies_around_and_on_either_side():
    planes = torch.linspace(0, 2, 41)[None]
    depth = torch.full((1, 3, 3), 0.4)
    depth[:, :, 2] = 1.2
    logits = -((planes[..., None, None] - depth[:, None]) ** 2) / 0.01
    step = torch.diff(planes, dim=1).mean(1)
    at_half = depth.repeat_interleave(2, 1).repeat_interleave(2, 2) + 0.01
    tried, about = close_depths(plane_modes(logits, planes), at_half, step)
    maps = tried.log_depth.unflatten(2, (6, 6))
    assert tried.cell == 2
    assert maps.shape[1] == COUNT
    for k, offset in enumerate(CLOSE):
        torch.testing.assert_close(maps[:, k], at_half + offset * 0.05)
    nearest, farthest = maps[0, len(CLOSE)], maps[0, len(CLOSE) + 1]
    assert nearest[0].tolist() == pytest.approx([0.4, 0.4, 0.4, 0.4, 0.4, 0.4], abs=0.01)
    assert farthest[0].tolist() == pytest.approx([0.4, 0.4, 1.2, 1.2, 1.2, 1.2], abs=0.01)
    assert float(about[0, 0, 0, 5]) == -5  # sixteen steps nearer
    assert float(about[0, 1, 0, 0]) == pytest.approx(-0.2, abs=0.05)
    assert not tried.log_depth.requires_grad


def test_the_choice_equals_a_loop():
    rng = torch.Generator().manual_seed(2)
    logits = 2 * torch.randn(1, COUNT, 4, 5, generator=rng)
    depths = 0.2 * torch.randn(1, COUNT, 4, 5, generator=rng)
    step = torch.tensor([0.1])
    found = chosen(logits, depths, step)
    for i in range(4):
        for j in range(5):
            weights = [math.exp(float(v)) for v in logits[0, :, i, j]]
            tried = depths[0, :, i, j].tolist()
            best = tried[weights.index(max(weights))]
            some = [
                (w, z)
                for w, z in zip(weights, tried, strict=True)
                if abs(z - best) <= ONE_SURFACE * 0.1
            ]
            mean = sum(w * z for w, z in some) / sum(w for w, _ in some)
            assert float(found[0, i, j]) == pytest.approx(mean, abs=1e-5)
