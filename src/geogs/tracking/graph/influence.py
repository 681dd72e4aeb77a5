"""How much a cell may say of a camera's place: something very near is often something that moves.

What a match does to a translation goes with the cell's inverse depth, and its share in the normal
equations with the square. What moves across a view that hardly changes looks like something very
near, gains the influence of that, and can turn the motion of the camera until it fits; then nothing
is left by which it could be told. Once it is told, what is near may count in full.
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
"""Multiple of the inverse depth that so much of a keyframe does not exceed, from which on cells
have no more influence: three medians in a room, four and a half on a street."""
LEAST = 0.01
"""Of a weight that is always left: before a far background all that tells a translation is near."""


def bounded_influence(inverse_depth: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
    """Factors on the weights of matches, by the inverse depths of their cells.

    One up to ``NEAREST`` times what is usual; beyond, such that the influence on a translation
    stays what it is there (a Mallows estimator: the bound depends on where a measurement was taken,
    not on how it fits). ``LEAST`` at least.
    """
    rank = 1 + int(FARTHER * (inverse_depth.shape[1] - 1))
    usual = inverse_depth.kthvalue(rank, 1, keepdim=True).values
    return (NEAREST * usual / inverse_depth.clamp(min=1e-9)).clamp(max=1).square().clamp(min=LEAST)


def solve_bounded(problem: StreamedProblem, solve: Solve, options: BundleOptions) -> BundleResult:
    """Solve with the influence of what is near bounded, then for the depths alone without a bound:
    what a cell may say of poses is one thing, what its matches say of its own depth another."""
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
