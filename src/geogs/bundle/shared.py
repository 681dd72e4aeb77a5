"""Bundle adjustment with shared unknowns: a lens, and the readout of a shutter.

Levenberg-Marquardt on the tracker's cost (:mod:`geogs.bundle.dense`) with a block of unknowns in
addition to poses and inverse depths: depths are eliminated frame by frame, then poses and block are
solved together in float64. The first pose is fixed; the scale, which is not measured, is fixed by a
penalty along it, so that nothing else constrains the block.

All of it is on the CPU, where matches are linearised by compiled loops
(:mod:`geogs.bundle.lens_flow`).
"""

import math
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.dense import DenseSchur, LinearBundle
from geogs.bundle.flow_term import residual_norms
from geogs.bundle.lens import LensBlock
from geogs.bundle.lens_flow import LensFlow
from geogs.bundle.problem import BundleProblem
from geogs.bundle.protocols import BundleOptions, BundleResult
from geogs.bundle.terms import BundleState
from geogs.geometry.least_squares import Policy, minimise
from geogs.geometry.lie import se3_inverse

OPTIONS = BundleOptions(iterations=15, damping=1e-3, depth_damping=1e-5)
"""Options for shared unknowns; the iterations are the most linearisations."""
LARGEST_STEP = 0.3
"""Largest step of an unknown of the lens."""
LEAST_DECREASE = 1e-4
"""Relative decrease of the cost below which a step is the last one."""


@dataclass(frozen=True, kw_only=True)
class SharedResult(BundleResult):
    """The adjusted problem, and the covariance of the block."""

    block: LensBlock
    cost: float
    """Mean Huber cost of a residual over the matched cells, in variances of a match."""
    covariance: Float[Tensor, "m m"]
    """Covariance of the block's unknowns, zero for those that are no variables; see
    :func:`solve_shared`."""


def solve_shared(
    problem: BundleProblem,
    block: LensBlock,
    options: BundleOptions = OPTIONS,
    least_decrease: float = LEAST_DECREASE,
) -> SharedResult:
    """Adjust all free poses, all inverse depths and the block; every frame's depth is free.

    The covariance is ``S^-1``, as for independent errors of matches, plus the cluster-robust one
    (Liang and Zeger's sandwich), ``S^-1 (sum_i g_i g_i^T) S^-1`` with the reduced gradient ``g_i``
    of each source frame, since the errors of neighbouring cells, and of one cell in several
    targets, are correlated. Where there is hardly any evidence, as for a camera that never rotates,
    the few gradients agree by chance. A non-finite step ends the adjustment.
    """
    shared = SharedSchur(problem, options)
    start = BundleState(problem.T_cw, problem.inverse_depth, block)
    policy = Policy(
        max_trials=options.iterations,
        damping=options.damping,
        max_damping=1e3,
        least_raised=1e-6,
        least_decrease=least_decrease,
    )
    found = minimise(start, shared.linearise, shared.step, policy, shared.cost)
    state = found.state
    linear = found.linear or shared.linearise(found.state)
    covariance = _covariance(linear)
    return SharedResult(
        state.T_cw,
        state.inverse_depth,
        shared.information,
        found.finite and bool(torch.isfinite(covariance).all()),
        block=cast(LensBlock, state.block),
        cost=found.cost,
        covariance=covariance,
    )


class SharedSchur(DenseSchur):
    """One adjustment with shared unknowns of the projection."""

    floor = 1e-6

    def __init__(self, problem: BundleProblem, options: BundleOptions) -> None:
        super().__init__(problem, LensFlow(), options)

    def linearise(self, state: BundleState) -> LinearBundle:
        """Linearise the problem, with a penalty that fixes the scale."""
        linear = super().linearise(state)
        system = linear.system
        T = state.T_cw
        diagonal = torch.zeros_like(system.gradient)
        for source in linear.sources:
            assert source.diagonal is not None
            diagonal[source.edges.rows(len(T))] += source.diagonal
        centre = se3_inverse(T[0])[:3, 3]
        away = (T[:, :3, :3] @ centre + T[:, :3, 3]).double()
        scale = torch.zeros_like(diagonal)
        scale[: away.numel() * 2] = torch.cat([away, 0 * away], 1).reshape(-1)
        scale = scale / scale.norm().clamp(min=1e-12)
        system.hessian += diagonal.mean() * scale[:, None] * scale
        return linear

    def solve_cameras(self, linear: LinearBundle, damping: float) -> Float[Tensor, "v"] | None:
        """Solve, with the step of the lens clamped to ``LARGEST_STEP``."""
        step = super().solve_cameras(linear, damping)
        if step is not None:
            step[6 * linear.system.frames :].clamp_(-LARGEST_STEP, LARGEST_STEP)
        return step

    def cost(self, state: BundleState, linear: LinearBundle | None = None) -> float:
        """Return the mean cost over the matched cells; infinite without any."""
        matched = int((self.problem.weight[..., 0] > 0).sum())
        return super().cost(state) / matched if matched else math.inf


def usual_residual(problem: BundleProblem, result: SharedResult) -> float:
    """Return the median residual, in own deviations, of the matches in front of their targets, for
    an adjusted problem."""
    source = problem.source
    depth = result.inverse_depth[problem.source]
    at = result.block.project(result.T_cw, source, problem.target, depth)
    found = residual_norms(at, problem.unrolled(result.block.readout), problem.weight)
    return float(found[at.valid & (problem.weight[..., 0] > 0)].median())


def _covariance(linear: LinearBundle) -> Float[Tensor, "m m"]:
    """Compute the covariance of the block's unknowns, see :func:`solve_shared`."""
    system = linear.system
    sources = linear.sources
    H = system.hessian
    free = system.free
    first = 6 * system.frames
    out = H.new_zeros(len(H) - first, len(H) - first)
    chosen = free[free >= first] - first
    if not len(chosen) or len(sources) < 2:
        return out
    unit = H.new_zeros(len(free), len(chosen))
    unit[-len(chosen) :] = torch.eye(len(chosen), dtype=H.dtype)
    reduced = H[free[:, None], free]
    rows, info = torch.linalg.solve_ex(reduced + 1e-9 * torch.diag(reduced.diagonal().abs()), unit)
    if int(info):
        return out + torch.nan
    pull = H.new_zeros(len(H), len(chosen))
    pull[free] = rows
    each = torch.stack(
        [pull[s.edges.rows(system.frames)].mT @ s.edges.chained()[1] for s in sources]
    )
    each = each - each.mean(0)
    common = len(sources) / (len(sources) - 1) * each.mT @ each
    out[chosen[:, None], chosen] = common + rows[-len(chosen) :]
    return out
