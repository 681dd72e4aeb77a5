"""How well an adjustment knows its poses and inverse depths: marginal variances at its solution.

With the reduced camera system S of all terms (depths eliminated) and the coupling e of an inverse
depth with the poses, ``var d = 1/c + e^T S^-1 e / c^2``: what its own matches leave open, and what
the poses do. Source: the block inverse; Rosinol et al. 2023 use it for dense bundle adjustment.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.flow_term import SourceFlow, linearised_sources, weighed_residuals
from geogs.bundle.lens_flow import LensFlow
from geogs.bundle.problem import sources_within
from geogs.bundle.projection import linearise, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.uncertainty.thinned import AnyProblem, ThinnedProblem
from geogs.geometry.lie import se3_inverse
from geogs.geometry.robust import weighted_median
from geogs.world.grid import SampleGrid

ALIKE = 2.25
"""Matches of neighbouring cells err alike, and so do those of one cell along several edges: by how
much their sum says less than its weights do. Measured on rendered rooms at the start of a map,
where the errors are 0.4 to 0.9 of what the weights foretell in the median, and up to 1.3 times that
at their upper tenth."""
DEPTHS_ALIKE = 0.56
"""The same of what is said of depths, for the path as long as it is: errors of cells among the best
known are 0.3 to 0.7 of what ``ALIKE`` foretells, and less what they have in common, in 20 rendered
clips of one to two seconds (docs/notebook/uncertainty.md)."""
BEST_KNOWN = 0.15
"""Part of a keyframe's cells that stands for its depths, half again as many as frames are followed
by. Of bare walls matches tell nothing, however far the camera has moved; what stands before them is
no worse known for it."""
PLACES = 8, 5
"""Parts of the image, across and down; what matches of one part have in common is taken for
independent of what those of another have."""
COMMON_FLOW = 0.1
"""What matches of a part have in common all along a video, in their own deviations, of the way by
which the scene moves in the image: the other way round from a later to an earlier frame."""
COMMON_PLACE = 0.15
"""The same of the place in the image, whichever frame is the earlier; beside what an error of the
lens does (:mod:`geogs.bundle.uncertainty.lens_error`)."""


class Considered(NamedTuple):
    """Second moments of the moves of a solution by errors that are not solved for."""

    covariance: Float[Tensor, "m m"]
    """Second moments of all poses, in the order of :class:`Marginals`."""
    relative_depth: Float[Tensor, "n c"]
    """Squares of the moves of its cells' inverse depths, as parts of these."""
    focal: float = 0.0
    """Square of the error of the focal length, as a part of it, which the width of things shares
    and no depth does."""


@dataclass(frozen=True)
class Marginals:
    """Variances of the free unknowns of a problem, in units and radians; on the CPU.

    Zero for what is fixed, infinite for what no match tells of.
    """

    covariance: Float[Tensor, "m m"]
    """Covariance of the left perturbations of all poses, m = 6n; float64."""
    relative_depth: Float[Tensor, "n c"]
    """Deviation of the inverse depth of some cells of each frame, as a part of it."""
    normalised_residual: Float[Tensor, "n"]
    """Median residual of the matches from each frame, in their own standard deviations (two
    dimensions), each counted by what it says: 1.2 where errors are as expected, more where the
    scene is not as modelled."""
    focal_variance: float = 0.0
    """Variance of the focal length, as a fraction of it."""
    focal_change: float = 0.0
    """Difference of the focal lengths that parts of the video want, as a fraction of them."""
    lens_change: float = 0.0
    """Part of the matches' cost that a lens of each frame of its own would take off."""

    @property
    def pose(self) -> Float[Tensor, "n 6 6"]:
        """Covariance of the left perturbation of each pose; float64."""
        n = len(self.covariance) // 6
        return self.covariance.reshape(n, 6, n, 6).diagonal(dim1=0, dim2=2).permute(2, 0, 1)

    @property
    def is_bounded(self) -> bool:
        """Whether matches tell of all poses."""
        return bool(self.covariance.isfinite().all())

    def beside(self, errors: Considered) -> "Marginals":
        """With errors that are independent of these."""
        relative = (self.relative_depth.square() + errors.relative_depth).sqrt()
        covariance, focal = self.covariance + errors.covariance, self.focal_variance + errors.focal
        return replace(self, covariance=covariance, relative_depth=relative, focal_variance=focal)

    @property
    def depth_deviation(self) -> Float[Tensor, "n"]:
        """Worst deviation among the ``BEST_KNOWN`` fraction of each frame's cells; infinite where
        fewer have matches."""
        return self.relative_depth.quantile(BEST_KNOWN, -1, interpolation="higher")


def marginals(
    grid: SampleGrid, problem: AnyProblem, options: BundleOptions, cells: int = 1024
) -> Marginals:
    """Marginal variances at the present state of a problem, its matches as good as they say.

    Args:
        grid: where the depths are.
        problem: at its solution; a large one is linearised in parts, twice.
        options: Huber's limit and the damping of depths.
        cells: most cells of a frame that are looked at, evenly spread; the others' matches are
            taken to be as good.

    Where at most one pose is fixed, lengths are relative to the distances of the cameras from it.
    """
    part = ThinnedProblem(grid, problem, cells)
    n = len(problem.T_cw)
    poses = torch.zeros(6 * n, 6 * n, dtype=torch.float64)
    for source in part.sources(options):
        rows = source.edges.rows(n)
        poses[rows[:, None], rows] += source.edges.chained()[0] / part.fraction
    covariance = ALIKE * pose_covariance(problem, poses)
    relative = torch.zeros(n, part.count)
    relative[problem.free_depth.cpu()] = torch.inf
    for source in part.sources(options):
        frame = source.frame
        if bool(problem.free_depth[frame]):
            variance = DEPTHS_ALIKE / ALIKE * _depth_variance(source, covariance)
            sigma = variance.sqrt()
            relative[frame] = sigma / part.inverse_depth[frame].clamp(min=1e-12)
    return Marginals(covariance, relative, _normalised_residual(problem, part, options))


def common_errors(
    grid: SampleGrid,
    problem: AnyProblem,
    options: BundleOptions,
    found: Marginals,
    cells: int = 1024,
) -> Considered:
    """What matches have wrong in common, beside what ``found`` says of poses and depths.

    A glossy floor, a slanted wall, a texture that is smoothed alike in all images: such errors are
    small beside those of a single match, but neither cells nor keyframes average them. No residual
    tells of them, as the solution follows them. Each is a number of its own, for a part of the
    image and an axis, that is not solved for; by how much it moves the solution follows from the
    equations that ``found`` is the inverse of. Source: consider analysis (Schmidt 1966; Bierman
    1977). Zero where ``found`` knows nothing.

    Args:
        grid, problem, options, cells: as of :func:`marginals`, which gave ``found``.
    """
    relative = torch.zeros_like(found.relative_depth)
    if not found.is_bounded:
        return Considered(torch.zeros_like(found.covariance), relative)
    part = ThinnedProblem(grid, problem, cells)
    n = len(problem.T_cw)
    pull = torch.zeros(6 * n, 4 * PLACES[0] * PLACES[1], dtype=torch.float64)
    place, owns = _places(part), []
    for source, on_poses, own in _common_pulls(part, options, place):
        pull[source.edges.rows(n)] += on_poses / part.fraction
        owns.append(own)
    moves = found.covariance / ALIKE @ pull
    for source, own in zip(part.sources(options), owns, strict=True):
        on_depths = (own[:, :, None] * place).permute(1, 0, 2).flatten(1)
        relative[source.frame] = part.depth_moves(source, on_depths, moves).square().sum(1)
    return Considered(moves @ moves.mT, relative)


def _common_pulls(
    thinned: ThinnedProblem, options: BundleOptions, place: Float[Tensor, "p q"]
) -> Iterator[tuple[SourceFlow, Float[Tensor, "c k"], Float[Tensor, "4 p"]]]:
    """Each source in order, and by how much each error that matches have in common, at its
    deviation, pulls at the poses that it joins once depths have followed, and at its depths.

    Of each axis there are two, along the flow and of the place, wherever in the image: an error in
    a part of it pulls at the depths that are there (``place``).
    """
    flow = LensFlow(thinned.lens)
    for part in thinned.parts(options):
        i, j = part.source, part.target
        T_ji = relative_motion(part.T_cw, i, j)
        p = linearise(thinned.camera, thinned.rays, T_ji, part.inverse_depth[i])
        _, w = weighed_residuals(p, part.pixels, part.weight, options.huber)
        unit = w * part.weight.clamp(min=1e-12).rsqrt()  # weight times one deviation
        onward = (j - i).sign() * COMMON_FLOW
        size = torch.stack([onward, torch.full_like(onward, COMMON_PLACE)])
        pose, own = p.pose_jacobian * unit.mT[:, None], (p.depth_jacobian * unit).mT
        sources = linearised_sources(flow, part, part.start, options)
        for source, (frame, e) in zip(sources, sources_within(i), strict=True):
            depth, chain = source.depth, source.edges.chain
            follow = depth.coupling / depth.curvature * float(part.free_depth[frame])
            along = torch.einsum("se,ekap->asekp", size[:, e], pose[e]).flatten(0, 1).flatten(1, 2)
            owns = torch.einsum("se,eap->asp", size[:, e], own[e]).flatten(0, 1)
            pulls = (along - follow * owns[:, None]) @ place
            yield source, chain.mT @ pulls.permute(1, 0, 2).flatten(1).double(), owns


def _places(thinned: ThinnedProblem) -> Float[Tensor, "c q"]:
    """One where a cell lies in a part of the image."""
    across, down = PLACES
    camera, pixels = thinned.camera, thinned.pixels
    x, y = (pixels / pixels.new_tensor([camera.width, camera.height])).mT
    at = (y * down).long() * across + (x * across).long()
    return torch.nn.functional.one_hot(at, across * down).to(pixels)


def pose_covariance(problem: AnyProblem, H: Float[Tensor, "m m"]) -> Float[Tensor, "m m"]:
    """Inverse of a reduced camera system over all poses, zero for the fixed ones.

    Infinite where that cannot be told. Where at most one pose is fixed, the unit of length is.
    """
    fixed = ~problem.free_pose.cpu()
    free = torch.nonzero(~fixed.repeat_interleave(6))[:, 0]
    S = H[free[:, None], free]  # changed in place: of three hundred poses it takes 26 MiB
    if int(fixed.sum()) <= 1:
        origin = int(torch.nonzero(fixed)[0, 0]) if bool(fixed.any()) else 0
        along = _scaling(problem.T_cw.double().cpu(), origin)[free]
        S.addr_(along, along, alpha=1e3 * float(H.diagonal().max()))
    # What no match tells of is open, not an error: its variance becomes very large.
    S.diagonal().add_(1e-9 * (S.diagonal().abs() + 1e-6))
    S, failed = torch.linalg.cholesky_ex(S)
    S = torch.full_like(S, torch.inf) if int(failed) else torch.cholesky_inverse(S)
    covariance = torch.zeros_like(H)
    covariance[free[:, None], free] = S
    return covariance


def _normalised_residual(
    problem: AnyProblem, part: ThinnedProblem, options: BundleOptions
) -> Float[Tensor, "n"]:
    """Median residual from each frame; infinite without matches.

    Matches count by their information. On a bare wall the flow continues what is around it, so its
    residuals are small however badly the others fit: counted by number, an image would seem the
    better known the more of it is bare.
    """
    found = torch.full((len(problem.T_cw),), torch.inf)
    for frame, norm, information in part.residuals(options):
        if len(norm):
            found[frame] = weighted_median(norm, information.double())
    return found


def _scaling(T_cw: Float[Tensor, "n 4 4"], origin: int) -> Float[Tensor, "m"]:
    """Unit step of all poses in which their distances from one camera grow together."""
    away = T_cw[:, :3, :3] @ se3_inverse(T_cw[origin])[:3, 3] + T_cw[:, :3, 3]
    along = torch.cat([away, torch.zeros_like(away)], 1).reshape(-1)
    return along / along.norm().clamp(min=1e-12)


def _depth_variance(source: SourceFlow, covariance: Float[Tensor, "m m"]) -> Float[Tensor, "c"]:
    """Variance of a source's inverse depths, by its matches and the covariance of its poses."""
    depth, rows = source.depth, source.edges.rows(len(covariance) // 6)
    E = source.edges.chained_coupling()
    among = covariance[rows[:, None], rows].to(E)
    through_poses = (E * (among @ E)).sum(0) / depth.curvature.square()
    return torch.where(depth.information > 0, ALIKE / depth.curvature + through_poses, torch.inf)
