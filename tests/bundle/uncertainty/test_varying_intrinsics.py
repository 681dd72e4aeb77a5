"""Lenses of the frames' own against a dense system by automatic differentiation, and planted."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from bundle_scenes import CAMERA
from geogs.bundle.dense import DenseBundle
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import project, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.uncertainty.lens_error import SHAPES, lens_evidence, shifts_of_edges
from geogs.bundle.uncertainty.varying_intrinsics import (
    FIRST,
    OWN,
    VaryingEvidence,
    VaryingPrior,
    considered_lenses,
    varying_evidence,
)
from geogs.geometry.lie import se3_exp
from geogs.world.grid import SampleGrid

EXACT = BundleOptions(huber=1e6, depth_damping=0.0)
SOLVED = BundleOptions(iterations=20, huber=1e6, damping=1e-6, depth_damping=1e-9)
# The scale is free: damping stays above the rounding that any processor's factorisation has.
N = 4
SHARED = torch.full((SHAPES,), 0.02, dtype=torch.float64)
TIMES = torch.arange(N, dtype=torch.float64)


def walk(sizes: Tensor, noise: float = 0.0) -> tuple[SampleGrid, BundleProblem]:
    """Views aside and turning, of lenses with errors of these sizes (n, 5), every match exact."""
    grid, n = SampleGrid(CAMERA), len(sizes)
    k = torch.arange(n, dtype=torch.float64)
    xi = torch.stack([0.1 * k, 0.05 * k.sin(), -0.06 * k, 0.02 * k, 0.05 * k, 0.03 * k.cos()], 1)
    g = torch.Generator().manual_seed(5)
    T, d = se3_exp(xi), 0.5 + 0.6 * torch.rand(n, grid.size, generator=g)
    pairs = [(i, j) for i in range(n) for j in range(n) if 0 < abs(i - j) < 3]
    source, target = (torch.tensor([p[m] for p in pairs]) for m in (0, 1))
    T_ji = relative_motion(T, source, target)
    at = project(CAMERA, grid.rays, T_ji, d[source])
    both = torch.stack([sizes[source], sizes[target]], 1).to(at.pixels)
    seen = at.pixels - shifts_of_edges(CAMERA, grid.rays, T_ji, at, both)
    seen = seen + noise * torch.randn(seen.shape, generator=g)
    inside = grid.inside(at.pixels)[..., None].expand_as(seen)
    free = torch.ones(n, dtype=torch.bool)
    free[0] = False
    weight = 100.0 * inside
    return grid, BundleProblem(
        T, d, source, target, free, torch.ones_like(free),
        pixels=torch.where(inside, seen, grid.centre), weight=weight,
    )  # fmt: skip


def evidence(sizes: Tensor, noise: float = 0.0) -> VaryingEvidence:
    """At the solution for a lens that stays."""
    grid, problem = walk(sizes, noise)
    solved = DenseBundle(grid).solve(problem, SOLVED)
    problem = replace(problem, T_cw=solved.T_cw, inverse_depth=solved.inverse_depth)
    found = varying_evidence(grid, problem, EXACT, grid.size)
    assert found is not None
    return found


def dense_system(own_rays: Tensor, problem: BundleProblem) -> tuple[Tensor, Tensor]:
    """Information and gradient of all sizes, everything else eliminated from a dense Jacobian."""
    n, p = problem.inverse_depth.shape
    rays, d0 = own_rays.double(), problem.inverse_depth.double()
    sizes = len(OWN) * n + SHAPES

    def residual(x: Tensor) -> Tensor:
        xi, depth, lens = x.split([6 * n, n * p, sizes])
        T = se3_exp(xi.reshape(n, 6)) @ problem.T_cw
        T_ji = relative_motion(T, problem.source, problem.target)
        at = project(CAMERA, rays, T_ji, (d0 + depth.reshape(n, p))[problem.source])
        each = lens[-SHAPES:].expand(n, -1).clone()
        each[:, list(OWN)] += lens[:-SHAPES].reshape(n, -1)
        both = torch.stack([each[problem.source], each[problem.target]], 1)
        shift = shifts_of_edges(CAMERA, rays, T_ji, at, both)
        weight = (problem.weight * at.valid[..., None]).double().sqrt()
        return (weight * (problem.pixels.double() + shift - at.pixels)).reshape(-1)

    zero = torch.zeros(6 * n + n * p + sizes, dtype=torch.float64)
    J, r = torch.autograd.functional.jacobian(residual, zero), residual(zero)
    H, g = J.mT @ J, -(J.mT @ r)
    first = 6 * n + n * p
    others = torch.arange(6, first)  # the first pose is fixed
    A = H[others[:, None], others]
    scale = torch.linalg.pinv(A, hermitian=True, rtol=1e-12)
    cross = H[others][:, first:]
    return H[first:, first:] - cross.mT @ scale @ cross, g[first:] - cross.mT @ scale @ g[others]


def test_normal_equations_are_those_of_a_dense_jacobian():
    grid, problem = walk(torch.zeros(N, SHAPES), noise=0.05)
    step, rays = 5, grid.rays[::5]
    found = varying_evidence(grid, problem, EXACT, -(-grid.size // step))
    assert found is not None
    part = replace(
        problem, inverse_depth=problem.inverse_depth[:, ::step], pixels=problem.pixels[:, ::step],
        weight=problem.weight[:, ::step],
    )  # fmt: skip
    information, gradient = (x * grid.size / len(rays) for x in dense_system(rays, part))
    scale = information.diagonal().sqrt()
    off = (found.information - information) / (scale[:, None] * scale)
    assert float(off.abs().max()) < 2e-3
    assert float(((found.gradient - gradient) / scale).abs().max()) < 5e-2


def test_what_all_share_is_what_one_lens_says():
    grid, problem = walk(torch.zeros(N, SHAPES), noise=0.05)
    one = lens_evidence(grid, problem, EXACT, grid.size)
    found = varying_evidence(grid, problem, EXACT, grid.size)
    assert one is not None
    assert found is not None
    np.testing.assert_allclose(
        found.information[-SHAPES:, -SHAPES:], one.information.sum(0), rtol=2e-2, atol=1.0
    )


def planted(focal: bool) -> Tensor:
    own = torch.zeros(N, SHAPES, dtype=torch.float64)
    wave = torch.tensor([0.01, -0.012, 0.009, -0.007], dtype=torch.float64)
    own[:, 0 if focal else OWN[1]] = wave
    return own


@pytest.mark.parametrize("focal", [True, False])
def test_matches_tell_the_lens_of_each_frame_and_which_of_its_sizes_varies(focal):
    sizes = planted(focal)
    found = evidence(sizes)
    step, prior = found.told(TIMES, torch.zeros_like(found.gradient), FIRST, SHARED)
    assert found.explained(step) > 0.8
    own = step[:-SHAPES].reshape(N, -1)
    want = sizes[:, list(OWN)]
    got, want = (x - x.mean(0) for x in (own, want))  # the mean is the lens of all
    assert float((got - want).square().mean().sqrt()) < 0.3 * float(want.square().mean().sqrt())
    jitter, *centre, drift = prior.deviations
    alone = [max(jitter, drift), *centre]
    varying = alone.pop(0 if focal else 1)
    assert varying > 1.5 * max(alone)  # four frames tell little


def test_of_a_lens_that_stays_nothing_is_to_be_explained():
    found = evidence(torch.zeros(N, SHAPES), noise=0.1)
    step, prior = found.told(TIMES, torch.zeros_like(found.gradient), FIRST, SHARED)
    assert found.explained(step) < 0.05
    assert max(prior.deviations[:3]) < 0.005  # four frames tell little of a deviation


def test_deviations_are_those_that_samples_were_drawn_with():
    n, g = 400, torch.Generator().manual_seed(2)
    times = torch.arange(n, dtype=torch.float64) / 30
    own = torch.randn(n, 3, generator=g).double() * torch.tensor([0.003, 0.01, 0.001]).double()
    own[:, 0] += (0.05 / n**0.5) * torch.randn(n, generator=g).double().cumsum(0)
    prior = FIRST
    for _ in range(60):
        prior = prior.suited(times, own, torch.zeros(n, 3, n, 3).double())
    assert prior.deviations[:3] == pytest.approx((0.003, 0.01, 0.001), rel=0.2)
    assert prior.deviations[3] == pytest.approx(0.05, rel=0.4)


def test_times_need_not_grow_as_those_of_a_saved_map_do_not():
    times = torch.tensor([2.0, 3.0, 0.0, 1.0], dtype=torch.float64)
    order = times.argsort()
    found, sorted_ = FIRST.information(times), FIRST.information(times[order])
    np.testing.assert_allclose(found[:, order][:, :, order], sorted_, rtol=1e-9)
    assert bool((torch.linalg.eigvalsh(found) > 0).all())


def test_between_keyframes_a_focal_length_is_known_worst_half_way():
    prior = VaryingPrior((0.001, 0.002, 0.003, 0.04))
    found = prior.between(np.array([0.0, 1.0, 4.0]), np.array([0.0, 0.5, 1.0, 2.5]))
    focal = [0.001**2 + 0.04**2 * part for part in (0, 0.25 / 4, 0, 0.25 * 3 / 4)]
    np.testing.assert_allclose(found[:, 0], np.sqrt(focal))
    np.testing.assert_allclose(found[:, 1:], np.tile([0.002, 0.003], (4, 1)))


def test_what_is_left_open_of_lenses_moves_poses_and_depths_the_more_they_vary():
    grid, problem = walk(torch.zeros(N, SHAPES), noise=0.05)
    evidence = varying_evidence(grid, problem, EXACT, 64)
    assert evidence is not None
    little, much = (
        considered_lenses(
            evidence, grid, problem, EXACT, 64, size * planted(True)[:, list(OWN)], TIMES, SHARED
        )
        for size in (0.1, 3.0)
    )
    assert float(much.covariance.trace()) > float(little.covariance.trace()) > 0
    assert float(much.relative_depth.mean()) > float(little.relative_depth.mean()) > 0
