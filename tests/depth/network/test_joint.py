"""The joint depth engine against a loop over pixels, and both its engines."""

import math

import numpy as np
import pytest
import torch

from depth_scene import make_scene
from geogs.config import DepthConfig
from geogs.depth.depth_engine import DepthTask
from geogs.depth.depth_view import DenseDepth
from geogs.depth.engine_choice import depth_engine
from geogs.depth.network.engine import AGREE, CHOICE, DIFFER, MEAN, REACH, joined
from geogs.geometry.camera import Camera


def random_depth(seed: int, normal: bool) -> DenseDepth:
    rng = torch.Generator().manual_seed(seed)
    depth = 2 + 0.2 * torch.rand(9, 12, generator=rng)
    confidence = torch.rand(9, 12, generator=rng)
    return DenseDepth(
        depth, confidence, depth.median(), normal=torch.ones(9, 12, 3) if normal else None
    )


def logit(c: float) -> float:
    c = min(max(c, 0.02), 0.98)
    return math.log(c / (1 - c))


def for_second(by: tuple[float, ...], vote: float, c: list[float]) -> float:
    """What speaks for the second of two depths with these confidences."""
    return by[0] * vote - by[1] * logit(c[0]) + by[2] * logit(c[1]) + by[3]


def test_two_depths_are_joined_as_a_loop_does():
    first, second = random_depth(0, False), random_depth(1, True)
    vote = 0.1 * torch.randn(9, 12, generator=torch.Generator().manual_seed(2))
    found = joined(first, second, vote)
    agreeing = 0
    for y in range(9):
        for x in range(12):
            z = [float(d.depth[y, x]) for d in (first, second)]
            c = [float(d.confidence[y, x]) for d in (first, second)]
            choice = for_second(CHOICE, float(vote[y, x]), c)
            winner = 1 if choice >= 0 else 0
            if abs(math.log(z[0] / z[1])) < REACH:
                agreeing += 1
                w = 1 / (1 + math.exp(-for_second(MEAN, float(vote[y, x]), c)))
                depth = math.exp((1 - w) * math.log(z[0]) + w * math.log(z[1]))
                score = AGREE[0] * logit(max(c)) + AGREE[1] * logit(min(c)) + AGREE[2]
            else:
                depth = z[winner]
                score = DIFFER[0] * logit(c[winner]) + DIFFER[1] * logit(c[1 - winner])
                score += DIFFER[2] * abs(choice) + DIFFER[3]
            assert float(found.depth[y, x]) == pytest.approx(depth, rel=1e-4)
            assert float(found.confidence[y, x]) == pytest.approx(
                1 / (1 + math.exp(-score)), abs=1e-3
            )
    assert 10 < agreeing < 100
    assert found.normal is second.normal
    assert found.typical == pytest.approx(float(found.depth.median()))


@pytest.mark.system
def test_together_they_are_as_good_as_the_better_one(monkeypatch):
    working = Camera(fx=266.0, fy=266.0, cx=159.5, cy=119.5, width=320, height=240)
    render, found = working.resized(160, 120), {}
    scene = make_scene(0, working, render)
    tasks = [DepthTask(scene.views[0], scene.views[1:5])]
    engine = depth_engine("cpu", render, working, DepthConfig(engine="joint"), 8)
    for name in ("classical", "network"):
        one = getattr(engine.classical, name)
        found[name] = one.estimate(tasks)
        monkeypatch.setattr(one, "estimate", lambda *_, name=name: found[name])
    found["joint"] = engine.estimate(tasks)
    errors = {n: np.abs(d.depth.numpy() / scene.truth[0] - 1) for n, (d,) in found.items()}
    right = {name: (error < 0.02).mean() for name, error in errors.items()}
    assert right["joint"] > max(right["classical"], right["network"]) - 0.005
    assert errors["joint"].mean() < 1.55 * min(errors[n].mean() for n in ("classical", "network"))
