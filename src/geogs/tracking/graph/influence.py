"""Bounded influence of near cells on the camera's pose: a very near object often moves.

The effect of a match on the translation is proportional to the cell's inverse depth, and its weight
in the normal equations to the square. An object that moves across a nearly static view looks very
near, gets a large influence, and can pull the camera's motion until it fits; then it can no longer
be detected. Once dynamic cells are detected, near cells may count in full.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.problem import StreamedProblem
from geogs.bundle.protocols import BundleOptions, BundleResult

Solve = Callable[[StreamedProblem, BundleOptions], BundleResult]

FARTHER, NEAREST = 0.75, 2.5
"""Quantile of a keyframe's inverse depth, and the multiple of it above which influence grows no
more: three medians in a room, four and a half on a street."""
LEAST = 0.01
"""Least factor on a weight: before a far background only near cells determine the translation."""


def bounded_influence(inverse_depth: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
    """Return factors on the weights of matches, by the inverse depths of their cells.

    One up to ``NEAREST`` times the usual inverse depth; beyond, the influence on a translation is
    constant (a Mallows estimator: the bound depends on where a measurement was taken, not on how
    it fits). ``LEAST`` at least.
    """
    rank = 1 + int(FARTHER * (inverse_depth.shape[1] - 1))
    usual = inverse_depth.kthvalue(rank, 1, keepdim=True).values
    return (NEAREST * usual / inverse_depth.clamp(min=1e-9)).clamp(max=1).square().clamp(min=LEAST)


def solve_bounded(problem: StreamedProblem, solve: Solve, options: BundleOptions) -> BundleResult:
    """Solve with bounded influence of near cells, then for the depths alone without a bound: only
    the influence on poses has to be limited, not that on a cell's own depth."""
    influence = bounded_influence(problem.inverse_depth)
    if bool((influence == 1).all()):
        return solve(problem, options)

    def matches(part: slice) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]:
        pixels, weight = problem.matches(part)
        source = problem.source[part].to(influence.device)
        return pixels, weight * influence[source][..., None]

    found = solve(replace(problem, matches=matches), options)
    none = torch.zeros_like(problem.free_pose)
    held = replace(
        problem, T_cw=found.T_cw, inverse_depth=found.inverse_depth, free_pose=none, pose_terms=()
    )
    of_depths = solve(held, replace(options, iterations=1))
    return replace(of_depths, finite=found.finite and of_depths.finite)
