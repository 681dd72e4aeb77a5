"""Adjustment with a lens against its reference and known lenses."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from geogs.bundle.flow_term import linearised_sources
from geogs.bundle.lens import LensBlock
from geogs.bundle.lens_flow import LensFlow
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.shared import OPTIONS, SharedSchur, solve_shared
from geogs.bundle.terms import BundleState
from lens_scene import CAMERA, GRID, disturbed, lens_problem
from oracles.calibration_reference import gauss_newton_step
from oracles.pinhole_flow import PinholeFlow


def test_edges_are_those_of_the_tracker_where_the_lens_is_its_pinhole():
    lens = CAMERA
    problem = disturbed(lens_problem(lens, frames=4, noise=0.5), 0.01, 0.03)
    options = BundleOptions(huber=1.0, depth_damping=1e-3)
    state = BundleState(problem.T_cw, problem.inverse_depth, LensBlock(lens, GRID.pixels))
    flows = LensFlow(), PinholeFlow(GRID.camera, GRID.rays)
    both = (linearised_sources(flow, problem, state, options) for flow in flows)
    for source, tracked in zip(*both, strict=True):
        own, theirs = source.edges, tracked.edges
        at = len(theirs.gradient)
        assert (source.frame, own.shared, theirs.shared) == (tracked.frame, 3, 0)
        scale = theirs.hessian.diagonal().sqrt()
        error = (own.hessian[:at, :at] - theirs.hessian) / (scale[:, None] * scale)
        assert float(error.abs().max()) < 1e-5
        torch.testing.assert_close(
            own.gradient[:at] / scale, theirs.gradient / scale, rtol=1e-4, atol=1e-2
        )
        torch.testing.assert_close(
            own.depth.information, theirs.depth.information, rtol=1e-4, atol=1e-3
        )


@pytest.mark.parametrize("huber", [0.5, 50.0])
def test_one_step_matches_the_dense_equations(huber):
    lens = CAMERA.moved(0.0, 0.05, -0.03)
    problem = disturbed(lens_problem(lens.moved(0.02, 0.01, 0.01), frames=3), 0.01, 0.03)
    xi, unknowns, delta = gauss_newton_step(
        problem, CAMERA, GRID.pixels, (0.05, -0.03), huber, 1e-5
    )
    block = LensBlock(lens, GRID.pixels, radial=True)
    shared = SharedSchur(problem, BundleOptions(huber=huber, depth_damping=1e-5))
    state = BundleState(problem.T_cw, problem.inverse_depth, block)
    linear = shared.linearise(state)
    step = shared.solve_cameras(linear, 0.0)
    assert step is not None
    depth = problem.inverse_depth + shared.depth_steps(state, linear, step)
    assert float(unknowns.abs().min()) > 1e-3
    torch.testing.assert_close(step[-3:], unknowns, rtol=2e-3, atol=2e-5)
    # Poses and depths agree up to the scale, which nothing measures.
    ours, theirs = step[6:-3].reshape(-1, 6), xi[1:]
    torch.testing.assert_close(ours[:, 3:], theirs[:, 3:], rtol=0, atol=5e-5)
    away, rest = problem.T_cw[1:, :3, 3].reshape(-1), (ours - theirs)[:, :3].reshape(-1)
    scale = float(away @ rest / (away @ away))
    torch.testing.assert_close(rest, scale * away, rtol=0, atol=1e-4)
    change = depth.double() - problem.inverse_depth - delta
    torch.testing.assert_close(change, -scale * problem.inverse_depth.double(), rtol=0, atol=2e-3)


def test_recovers_focal_length_and_radial_terms():
    truth = CAMERA.moved(0.0, -0.2, 0.05)
    start = disturbed(lens_problem(truth), 0.01, 0.05)
    guess = CAMERA.moved(math.log(1.25))
    options = replace(OPTIONS, iterations=40, huber=100.0)
    block = LensBlock(guess, GRID.pixels, radial=True)
    result = solve_shared(start, block, options, least_decrease=1e-9)
    assert result.finite
    found = result.block.lens
    assert abs(found.fx / CAMERA.fx - 1) < 1e-3
    assert abs(found.fy / CAMERA.fy - 1) < 1e-3
    assert abs(found.k1 + 0.2) < 1e-3
    assert abs(found.k2 - 0.05) < 1e-3


def test_deviations_are_those_of_repeated_measurements():
    errors, deviations = [], []
    for seed in range(16):
        problem = lens_problem(CAMERA, frames=8, noise=0.3, seed=seed)
        result = solve_shared(problem, LensBlock(CAMERA, GRID.pixels, radial=True))
        lens = result.block.lens
        errors.append([math.log(lens.fx / CAMERA.fx), lens.k1, lens.k2])
        deviations.append(result.covariance.diagonal().sqrt().tolist())
    actual = np.sqrt(np.square(errors).mean(0))
    said = np.sqrt(np.square(deviations).mean(0))
    assert (actual > 1e-4).all()
    assert ((actual / said > 0.5) & (actual / said < 2.0)).all(), (actual, said)


def test_what_is_no_variable_stays():
    problem = lens_problem(CAMERA.moved(0.0, 0.05).moved(0.1))
    lens = CAMERA.moved(0.0, 0.05)
    fixed = solve_shared(problem, LensBlock(lens, GRID.pixels, focal=False))
    assert fixed.block.lens == lens
    assert not fixed.covariance.any()
    torch.testing.assert_close(fixed.T_cw[0], problem.T_cw[0])
    focal = solve_shared(problem, LensBlock(lens, GRID.pixels))
    assert focal.block.lens.k1 == 0.05
    assert float(focal.covariance[1, 1]) == 0
    assert focal.block.lens.fx > 1.05 * CAMERA.fx


def test_matches_that_are_not_finite_are_reported():
    problem = lens_problem(CAMERA)
    problem.pixels[0, 0] = torch.nan
    result = solve_shared(problem, LensBlock(CAMERA, GRID.pixels))
    assert not result.finite
    assert result.block.lens == CAMERA
