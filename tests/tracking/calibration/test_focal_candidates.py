"""Lenses that calibration begins with, and what the adjustment makes of a barrel's flow."""

import math

import pytest
import torch

from geogs.bundle.lens import LensBlock
from geogs.bundle.problem import BundleProblem
from geogs.bundle.shared import solve_shared
from geogs.geometry.camera import Camera
from geogs.geometry.lie import so3_exp
from geogs.tracking.calibration.focal_candidates import Start, candidates, try_candidate
from geogs.tracking.calibration.growing_bundle import LEAST_DECREASE, PATIENT
from geogs.tracking.calibration.unknowns import Unknowns
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

GUESS = Camera(277.1, 277.1, 159.5, 119.5, 320, 240)
BARREL = GUESS.with_focal(224.0).moved(0.0, -0.185, 0.06)
LENS = Unknowns(radial=True)
NOISE = 0.3
"""Pixels."""


def swung(views: int, degrees: float) -> list[FlowMatch]:
    """Flow from the first view of a barrel lens that turns and moves sideways by a third of the
    typical depth, with noise."""
    g = torch.Generator().manual_seed(1)
    grid = SampleGrid(GUESS)
    x, y = ((grid.pixels - grid.pixels.mean(0)) / 160).double().unbind(-1)
    depth = 1 + 0.3 * torch.sin(4 * x + 1) * torch.cos(5 * y) + 0.4 * (x > 0.2)
    block, found = LensBlock(BARREL, grid.pixels), []
    for n in range(1, views):
        angle = math.radians(degrees) * n / (views - 1)
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = so3_exp(torch.tensor([0.1 * angle, angle, 0.05 * angle]).double())
        T[:3, 3] = torch.tensor([-0.33, 0.1, 0.05]).double() * n / (views - 1)
        both = torch.stack([torch.eye(4, dtype=torch.float64), T])
        p = block.project(both, torch.tensor([0]), torch.tensor([1]), (1 / depth).float()[None])
        q = p.pixels + NOISE * torch.randn(p.pixels.shape, generator=g)
        inside = ((q > 0) & (q < torch.tensor([319.0, 239.0]))).all(-1) & p.valid
        weight = (inside[..., None] / NOISE**2).expand_as(q)
        found.append(FlowMatch(q.float(), weight.float()))
    return found


def test_a_barrel_is_found():
    flows = swung(8, 20.0)
    tried = candidates(GUESS, LENS)
    starts = [try_candidate(lens, flows, 3.0, LENS) for lens in tried]
    for lens, start in zip(tried, starts, strict=True):
        if start is not None:
            print(round(lens.fx), lens.k1, "->", start.lens, round(start.cost, 3))
    best = min((s for s in starts if s is not None), key=lambda s: s.cost)
    assert best.lens.fx == pytest.approx(224.0, rel=0.015)
    assert best.lens.k1 == pytest.approx(-0.185, abs=0.02)


def test_from_both_sides_of_a_flat_valley_an_adjustment_comes_to_the_same_lens():
    """Of a turn by four degrees, which leaves the focal length open to some per cent."""
    flows, found = swung(8, 4.0), []
    for begun in (GUESS, BARREL):
        start = try_candidate(begun, flows, 3.0, LENS)
        assert start is not None
        n = len(flows) + 1
        problem = BundleProblem(
            start.T_cw,
            torch.cat([start.inverse_depth[None], torch.ones(n - 1, len(start.inverse_depth))]),
            torch.zeros(n - 1, dtype=torch.long),
            torch.arange(1, n),
            torch.arange(n) > 0,
            torch.ones(n, dtype=torch.bool),
            pixels=torch.cat([f.pixels for f in flows]),
            weight=torch.cat([f.weight for f in flows]),
        )
        block = LensBlock(start.lens, SampleGrid(GUESS).pixels, radial=True)
        result = solve_shared(problem, block, PATIENT, LEAST_DECREASE)
        print(start.lens.fx, result.block.lens, result.cost)
        found.append(result.block.lens.fx)
    assert found[0] == pytest.approx(found[1], rel=0.001)  # 0.005 by the usual options
    assert found[0] == pytest.approx(BARREL.fx, rel=0.015)


def test_of_a_known_distortion_only_pinholes_are_tried():
    assert all(lens.k1 == lens.k2 == 0 for lens in candidates(GUESS, Unknowns()))
    assert {lens.fx for lens in candidates(GUESS, Unknowns())} > {GUESS.fx}
    assert candidates(GUESS, Unknowns(focal=False)) == [GUESS]


def test_of_two_minima_the_lens_that_bends_as_lenses_do_counts():
    """Costs and lenses as of a Kinect that turns at 120 degrees/s, whose fx is 224."""

    def start(fx: float, k1: float, k2: float, cost: float) -> Start:  # one keyframe, one cell
        lens = Camera(fx, fx, 159.5, 119.5, 320, 240).moved(0.0, k1, k2)
        return Start(lens, torch.eye(4)[None], torch.ones(1), torch.ones(1), cost)

    wrong, right = start(274.1, 0.315, -0.586, 0.4788), start(233.6, 0.144, -0.255, 0.4941)
    assert right.penalised < wrong.penalised
    assert right.penalised == pytest.approx(0.4941 + 0.002 * (1.44**2 + 1.275**2))
    barrel, pinhole = start(224.0, -0.25, 0.06, 0.47), start(240.0, 0.0, 0.0, 0.52)
    assert barrel.penalised < pinhole.penalised  # what fits clearly better is not outvoted
