"""The error of a lens against lenses that bend, and against adjustments of what they show."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bundle_scenes import CAMERA
from geogs.bundle.dense import DenseBundle
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import project, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.uncertainty.lens_error import (
    FOCAL_LEFT,
    LEAST,
    RADIAL,
    SHAPES,
    LensEvidence,
    lens_evidence,
    lens_prior,
    lens_shapes,
)
from geogs.geometry.lie import se3_exp, se3_inverse, se3_log
from geogs.world.grid import SampleGrid

EXACT = BundleOptions(huber=50.0, depth_damping=0.0)
SOLVED = BundleOptions(iterations=20, huber=50.0, damping=1e-6, depth_damping=1e-9)
# The scale is free: damping stays above the rounding that any processor's factorisation has.


def walk(bend: tuple[float, ...] = (0.0, 0.0, 0.0)) -> tuple[SampleGrid, BundleProblem]:
    """Six views forward, a little aside, and turning, of a lens that is no pinhole of CAMERA's."""
    g, n, grid = torch.Generator().manual_seed(3), 6, SampleGrid(CAMERA)
    k = torch.arange(n, dtype=torch.float64)
    xi = torch.stack([0.03 * k, 0.02 * k.sin(), -0.08 * k, 0.02 * k, 0.06 * k, 0.03 * k.cos()], 1)
    T, d = se3_exp(xi), 0.5 + 0.6 * torch.rand(n, grid.size, generator=g)
    pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
    source, target = (torch.tensor([p[m] for p in pairs]) for m in (0, 1))
    true = pinhole(grid.pixels, bend)
    wanted = project(CAMERA, rays(true), relative_motion(T, source, target), d[source]).pixels
    seen = wanted
    for _ in range(5):  # whose pinhole's pixel is the wanted one
        seen = seen + wanted - pinhole(seen, bend)
    inside = grid.inside(wanted)[..., None].expand_as(seen)
    seen, weight = torch.where(inside, seen, grid.centre), 1e4 * inside
    free = torch.ones(n, dtype=torch.bool)
    free[0] = False
    return grid, BundleProblem(
        T, d, source, target, free, torch.ones_like(free), pixels=seen, weight=weight
    )


def pinhole(pixels: Tensor, bend: tuple[float, ...]) -> Tensor:
    """Where a pinhole would have seen what a lens shows at pixels."""
    shapes = lens_shapes(CAMERA, pixels)[: len(bend)]
    return pixels + torch.einsum("k,k...->...", torch.tensor(bend), shapes)


def rays(pixels: Tensor) -> Tensor:
    plane = (pixels - pixels.new_tensor([CAMERA.cx, CAMERA.cy])) / pixels.new_tensor(
        [CAMERA.fx, CAMERA.fy]
    )
    return torch.cat([plane, torch.ones_like(plane[:, :1])], 1)


def evidence(grid: SampleGrid, problem: BundleProblem, chunk: int = 24) -> LensEvidence:
    found = lens_evidence(grid, problem, replace(EXACT, chunk=chunk), grid.size, of_depths=True)
    assert found is not None
    return found


@pytest.mark.parametrize("bend", [(0.01, 0.0), (0.0, -0.02), (0.01, -0.03)])
def test_matches_tell_how_the_lens_bends(bend):
    found = evidence(*walk((0.0, *bend))).bend
    torch.testing.assert_close(found.size, torch.tensor(bend).double(), atol=3e-4, rtol=0.04)
    assert found.evidence > 50


def test_matches_tell_what_they_do_wherever_they_lie():
    grid, problem = walk((0.0, 0.01, -0.02))
    one, parts = evidence(grid, problem), evidence(grid, problem, chunk=6)
    torch.testing.assert_close(one.bend.size, parts.bend.size)
    assert one.joined(parts).bend.size == pytest.approx(one.bend.size)


def test_a_focal_length_that_is_off_is_told_beside_the_bend():
    all_ = evidence(*walk((0.004, 0.01, -0.02)))
    solved = torch.linalg.solve(all_.information.sum(0), all_.gradient.sum(0))
    wanted = torch.tensor([0.004, 0.01, -0.02, 0.0, 0.0]).double()
    torch.testing.assert_close(solved, wanted, atol=3e-4, rtol=0.04)


def test_a_principal_point_that_is_off_is_told_beside_the_bend():
    off = 0.002, 0.01, -0.02, 0.02, -0.03
    said = evidence(*walk(off)).whole()
    torch.testing.assert_close(said.size, torch.tensor(off).double(), atol=1.5e-3, rtol=0.06)
    assert said.of(slice(RADIAL, SHAPES)).evidence > 8


def test_a_principal_point_that_is_right_is_not_asked_for():
    """Against the normal equations of the other sizes alone."""
    found = evidence(*walk((0.002, 0.01, -0.02)))
    said = found.whole(with_centre=False)
    information, gradient = found.information.sum(0)[:3, :3], found.gradient.sum(0)[:3]
    torch.testing.assert_close(said.size, torch.linalg.solve(information, gradient))
    assert (said.deviation < found.whole().deviation[:3]).all()


def test_a_readout_that_is_off_is_told_beside_the_lens():
    """Rows shift matches by what differs from edge to edge, as the camera's velocity does."""

    def rows(part, rays, at):
        sway = torch.sin(2.0 * part.target + part.source)[:, None, None]
        return (at.pixels[..., 1:] - CAMERA.cy) * sway * torch.tensor([0.5, 0.1])

    grid, problem = walk((0.004, 0.01, -0.02))
    T_ji = relative_motion(problem.T_cw, problem.source, problem.target)
    at = project(CAMERA, grid.rays, T_ji, problem.inverse_depth[problem.source])
    pixels = problem.pixels - 0.03 * rows(problem, grid.rays, at)
    found = lens_evidence(grid, replace(problem, pixels=pixels), EXACT, grid.size, rows)
    assert found is not None
    assert not found.depth_moves.numel()  # nobody asked
    said = found.whole()
    wanted = torch.tensor([0.004, 0.01, -0.02, 0.0, 0.0, 0.03]).double()
    torch.testing.assert_close(said.size, wanted, atol=1e-3, rtol=0.06)
    # A size that was known before: against the sum of both normal equations.
    told = said.told(SHAPES, 0.02, 0.01)
    information = torch.linalg.inv(said.covariance)
    right = information @ said.size
    information[SHAPES, SHAPES] += 1e4
    right[SHAPES] += 1e4 * 0.02
    torch.testing.assert_close(told.size, torch.linalg.solve(information, right))
    torch.testing.assert_close(told.covariance, torch.linalg.inv(information))
    torch.testing.assert_close(said.without(0).size, said.told(0, 0.0, 1e-12).size[1:])


def test_the_change_of_the_focal_length_is_that_of_parts_beyond_their_deviations():
    """Against a plain loop over them."""
    g = torch.Generator().manual_seed(5)
    information = 1e4 * (0.5 + torch.rand(30, generator=g, dtype=torch.float64))
    wanted = torch.linspace(0, 0.3, 30) + 0.002 * torch.randn(30, generator=g)
    each = torch.zeros(30, SHAPES, SHAPES, dtype=torch.float64)
    each[:, 0, 0], gradient = information, torch.zeros(30, SHAPES, dtype=torch.float64)
    gradient[:, 0] = information * wanted
    sizes, deviations = [], []
    for first in range(0, 30, 5):
        i, b = information[first : first + 5], gradient[first : first + 5, 0]
        size = float(b.sum() / i.sum())
        sizes.append(size)
        left = sum(float(y - x * size) ** 2 for x, y in zip(i, b, strict=True))
        deviations.append((1 / float(i.sum()) + left / float(i.sum()) ** 2) ** 0.5)
    said = LensEvidence(each, gradient, torch.zeros(180, SHAPES), torch.zeros(30, 0, SHAPES))
    beyond = sizes[-1] - sizes[0] - 5 * (deviations[-1] ** 2 + deviations[0] ** 2) ** 0.5
    assert said.focal_change == pytest.approx(beyond, rel=1e-6)
    assert beyond > 0.02
    gradient[:, 0] = information * 0.3
    assert said.focal_change < 1e-9
    each[:10, 0, 0] = -1.0  # parts that tell nothing have no say
    gradient[:10, 0] = 1e4
    assert said.focal_change < 1e-9


def test_halves_agree_by_how_far_either_lowers_the_cost_of_the_other():
    """Against the costs themselves, as quadratics of all sizes."""
    g = torch.Generator().manual_seed(5)
    A = torch.randn(4, SHAPES, SHAPES, generator=g, dtype=torch.float64)
    H = A @ A.mT
    true = torch.tensor([0.0, 0.03, -0.05, 0.0, 0.0]).double()
    noise = 0.01 * torch.randn(4, SHAPES, generator=g).double()

    def half(of: slice, sign: float) -> LensEvidence:
        gradient = H[of] @ (sign * true) + noise[of]
        return LensEvidence(H[of], gradient, torch.zeros(0, SHAPES), torch.zeros(0, 0, SHAPES))

    def cost(evidence: LensEvidence, size: Tensor) -> float:
        size = torch.cat([size.new_zeros(1), size, size.new_zeros(2)])
        information, gradient = evidence.information.sum(0), evidence.gradient.sum(0)
        return float(size @ information @ size - 2 * gradient @ size)

    first, same, opposite = half(slice(2), 1), half(slice(2, 4), 1), half(slice(2, 4), -1)
    for other, least, most in ((same, 0.8, 1.0), (opposite, -10.0, -1.0)):
        fractions = [
            cost(a, b.bend.size) / cost(a, a.bend.size) for a, b in ((first, other), (other, first))
        ]
        assert first.agreement(other) == pytest.approx(min(fractions), rel=1e-6)
        assert first.agreement(other) == other.agreement(first)
        assert least < first.agreement(other) <= most
    assert first.agreement(first) == pytest.approx(1.0)


@pytest.mark.parametrize("bend", [(0.0, 0.0, 0.0), (0.05, 0.01, -0.02)])
def test_one_lens_that_is_another_than_was_said_is_no_zoom(bend):
    assert evidence(*walk(bend)).focal_change < 0.01


def test_noise_alone_is_no_evidence():
    grid, problem = walk()
    for seed in range(4):
        g = torch.Generator().manual_seed(seed)
        noise = 0.01 * torch.randn(problem.pixels.shape, generator=g)
        found = evidence(grid, replace(problem, pixels=problem.pixels + noise)).bend
        assert found.evidence < 20


def test_poses_and_depths_move_by_what_the_lens_does_to_them():
    """Against adjustments of what a lens shows."""
    size = 0.001
    grid, straight = walk()
    found = evidence(grid, straight)
    for n in range(SHAPES):
        bend = tuple(size * (k == n) for k in range(SHAPES))
        solved = DenseBundle(grid).solve(
            replace(walk(bend)[1], T_cw=straight.T_cw, inverse_depth=straight.inverse_depth), SOLVED
        )
        # An error of the lens that is taken off moves poses back.
        move = -same_length(solved.T_cw, straight.T_cw).reshape(-1)
        foretold = size * found.moves[:, n]
        assert float((move - foretold).norm() / move.norm()) < 0.03
        t = straight.T_cw[:, :3, 3]
        length = float((solved.T_cw[:, :3, 3] * t).sum() / t.square().sum())
        move = 1 - solved.inverse_depth * length / straight.inverse_depth
        foretold = size * found.depth_moves[..., n]
        seen = torch.zeros_like(move).index_add(0, straight.source, straight.weight[..., 0]) > 0
        assert not foretold[~seen].any()
        assert float((move - foretold)[seen].norm() / move[seen].norm()) < 0.03


def same_length(T: Tensor, truth: Tensor) -> Tensor:
    """Moves of poses whose lengths are brought to those of the truth, as covariances are."""
    T, t = T.clone(), T[:, :3, 3]
    T[:, :3, 3] /= float((t * truth[:, :3, 3]).sum() / truth[:, :3, 3].square().sum())
    return se3_log(T @ se3_inverse(truth))


@pytest.mark.parametrize(("readout", "guess"), [((), 0.0), ((0.4, 0.2), 0.0), ((), 0.35)])
def test_what_is_said_of_poses_is_the_mean_square_over_lenses(readout, guess):
    """Against lenses drawn by what is known of them, each seen with noise, and what they do; and
    readouts drawn by what is doubted of them."""
    g = torch.Generator().manual_seed(0)
    k = SHAPES + bool(readout)
    moves = torch.randn(12, k, generator=g, dtype=torch.float64)
    prior = torch.tensor([*lens_prior(guess), *readout[:1]]).double()
    noise = torch.tensor([0.01, 0.02, 0.2, 0.01, 0.01, *readout[1:]]).double()
    count = 40
    each = torch.diag(1 / noise.square())[None].expand(count, k, k) / count
    said, focal = torch.zeros(12, dtype=torch.float64), 0.0
    true = torch.zeros_like(said)
    for _ in range(1000):
        lens = prior * torch.randn(k, generator=g, dtype=torch.float64)
        seen = torch.randn(count, k, generator=g, dtype=torch.float64) / noise / count**0.5
        found = LensEvidence(each, each @ lens + seen, moves, moves[None])
        considered = found.considered(1.0, *(readout[:1] or (0.0,)), guess)
        torch.testing.assert_close(
            considered.covariance.diagonal(), considered.relative_depth[0].double()
        )
        said += considered.covariance.diagonal()
        focal += considered.focal
        true += (moves @ lens).square()
    assert float((said / true).log().abs().max()) < 0.25
    assert focal / 1000 == pytest.approx(float(prior[0] ** 2), rel=0.15)


def test_no_size_is_said_to_be_known_better_than_least():
    moves = torch.eye(SHAPES).double()
    each = 1e12 * moves.expand(2, SHAPES, SHAPES)
    found = LensEvidence(each, torch.zeros(2, SHAPES).double(), moves, moves[None])
    assert found.whole().deviation.tolist() == pytest.approx(LEAST[:SHAPES], rel=1e-5)
    assert found.bend.deviation.tolist() == pytest.approx(LEAST[1:RADIAL], rel=1e-5)
    assert float(found.considered().covariance.max()) < 1e-11  # which moves no pose


def test_without_evidence_the_lens_is_as_unsure_as_before():
    moves, nothing = torch.eye(SHAPES).double(), torch.zeros(2, SHAPES).double()
    found = LensEvidence(torch.zeros(2, SHAPES, SHAPES).double(), nothing, moves, moves[None])
    wanted = torch.diag(torch.tensor(lens_prior()).double().square())
    # Nothing is said of it, whatever is estimated.
    assert float((found.considered().covariance - wanted).abs().max()) < 1e-3 * float(wanted.max())
    more = found.considered(0.95).covariance - found.considered().covariance
    left = (FOCAL_LEFT * math.log(0.95)) ** 2
    assert torch.allclose(more, torch.diag(torch.tensor([left, 0, 0, 0, 0]).double()))
