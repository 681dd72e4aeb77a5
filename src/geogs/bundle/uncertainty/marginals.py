"""Marginal variances of an adjustment's poses and inverse depths at its solution.

With the reduced camera system S of all terms (depths eliminated) and the coupling e of an inverse
depth with the poses, ``var d = 1/c + e^T S^-1 e / c^2``: due to its own matches, and due to the
poses. Source: the block inverse; Rosinol et al. 2023 use it for dense bundle adjustment. Deviations
of poses after alignment with the truth do not depend on the choice of world frame and unit.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.flow_term import SourceFlow, linearised_sources, residual_norms, weighed_residuals
from geogs.bundle.lens_flow import LensFlow
from geogs.bundle.problem import sources_within
from geogs.bundle.projection import linearise, project, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.uncertainty.thinned import AnyProblem, ThinnedProblem
from geogs.geometry.lie import se3_inverse, so3_hat
from geogs.geometry.robust import weighted_median
from geogs.world.grid import SampleGrid

ALIKE = 2.25
"""Factor on variances, as errors of neighbouring cells, and of one cell along several edges, are
correlated. Measured on rendered rooms at the start of a map, where the errors are 0.4 to 0.9 of the
predicted ones in the median, and up to 1.3 times these at their upper tenth."""
DEPTHS_ALIKE = 0.56
"""The same factor for depths, given the length of the path: errors of the best known cells are 0.3
to 0.7 of those predicted with ``ALIKE``, and smaller without their common part, in 20 rendered
clips of one to two seconds (docs/notebook/uncertainty.md)."""
BEST_KNOWN = 0.15
"""Fraction of a keyframe's cells that represents its depths, half again as many as tracking needs.
Matches determine nothing on bare walls, however far the camera has moved, but objects in front of
them are known no less well."""
PLACES = 8, 5
"""Parts of the image, across and down; common errors of matches of different parts are assumed to
be independent."""
COMMON_FLOW = 0.1
"""Common flow error of the matches of a part along the whole video, as a fraction of their
deviation; its sign changes from a later to an earlier frame."""
COMMON_PLACE = 0.15
"""Common error of their position in the image, likewise, whichever frame is the earlier; apart from
that by an error of the lens (:mod:`geogs.bundle.uncertainty.lens_error`)."""


class Considered(NamedTuple):
    """Second moments of the changes of a solution by errors that are not solved for."""

    covariance: Float[Tensor, "m m"]
    """Second moments of all poses, in the order of :class:`Marginals`."""
    relative_depth: Float[Tensor, "n c"]
    """Squares of the relative changes of the cells' inverse depths."""
    focal: float = 0.0
    """Squared relative error of the focal length, which affects the width of things but not their
    depth."""


@dataclass(frozen=True)
class Marginals:
    """Variances of the free unknowns of a problem, in units and radians; on the CPU.

    Zero for fixed unknowns, infinite for those that no match determines.
    """

    covariance: Float[Tensor, "m m"]
    """Covariance of the left perturbations of all poses, m = 6n; float64."""
    relative_depth: Float[Tensor, "n c"]
    """Relative deviation of the inverse depth of some cells of each frame."""
    normalised_residual: Float[Tensor, "n"]
    """Median residual of the matches from each frame, in their own standard deviations (two
    dimensions), weighted by information: 1.2 where errors are as expected, more where the scene is
    not as modelled."""
    focal_variance: float = 0.0
    """Relative variance of the focal length."""
    focal_change: float = 0.0
    """Relative difference of the focal lengths that fit parts of the video best."""
    lens_change: float = 0.0
    """Fraction of the matches' cost that per-frame intrinsics would remove."""

    @property
    def pose(self) -> Float[Tensor, "n 6 6"]:
        """Covariance of the left perturbation of each pose; float64."""
        n = len(self.covariance) // 6
        return self.covariance.reshape(n, 6, n, 6).diagonal(dim1=0, dim2=2).permute(2, 0, 1)

    @property
    def is_bounded(self) -> bool:
        """Whether matches determine all poses."""
        return bool(self.covariance.isfinite().all())

    def beside(self, errors: Considered) -> "Marginals":
        """Add errors that are independent of these."""
        relative = (self.relative_depth.square() + errors.relative_depth).sqrt()
        covariance = self.covariance + errors.covariance
        focal = self.focal_variance + errors.focal
        return replace(self, covariance=covariance, relative_depth=relative, focal_variance=focal)

    @property
    def depth_deviation(self) -> Float[Tensor, "n"]:
        """Largest deviation among the ``BEST_KNOWN`` fraction of each frame's cells; infinite where
        fewer have matches."""
        return self.relative_depth.quantile(BEST_KNOWN, -1, interpolation="higher")


def marginals(
    grid: SampleGrid, problem: AnyProblem, options: BundleOptions, cells: int = 1024
) -> Marginals:
    """Compute marginal variances at the present state of a problem, from the matches' weights.

    Args:
        grid: of the depths.
        problem: at its solution; a large one is linearised in parts, twice.
        options: Huber threshold and the damping of depths.
        cells: most cells of a frame that are used, evenly spread; they represent the others.

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
    """Compute the effect of common errors of matches, which ``found`` does not include.

    A glossy floor, a slanted wall, a texture smoothed in the same way in all images: such errors
    are small compared with those of a single match, but averaging over cells and keyframes does not
    reduce them. Residuals do not show them, as the solution follows them. Each is one number for a
    part of the image and an axis, which is not solved for; its effect on the solution follows from
    the equations whose inverse is ``found``. Source: consider analysis (Schmidt 1966; Bierman
    1977). Zero where ``found`` is not bounded.

    Args:
        grid, problem, options, cells: as for :func:`marginals`, which gave ``found``.
    """
    relative = torch.zeros_like(found.relative_depth)
    if not found.is_bounded:
        return Considered(torch.zeros_like(found.covariance), relative)
    part = ThinnedProblem(grid, problem, cells)
    n = len(problem.T_cw)
    pull = torch.zeros(6 * n, 4 * PLACES[0] * PLACES[1], dtype=torch.float64)
    place = _places(part)
    owns = []
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
    """Yield each source in order, with the gradients of each common error, at its deviation, on the
    source's poses after elimination of depths, and on its depths.

    There are two for each axis, of flow and of position, over the whole image: an error in a part
    of it acts on the depths there (``place``).
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
        pose = p.pose_jacobian * unit.mT[:, None]
        own = (p.depth_jacobian * unit).mT
        sources = linearised_sources(flow, part, part.start, options)
        for source, (frame, e) in zip(sources, sources_within(i), strict=True):
            depth = source.edges.depth
            chain = source.edges.chain
            follow = depth.coupling / depth.curvature * float(part.free_depth[frame])
            along = torch.einsum("se,ekap->asekp", size[:, e], pose[e]).flatten(0, 1).flatten(1, 2)
            owns = torch.einsum("se,eap->asp", size[:, e], own[e]).flatten(0, 1)
            pulls = (along - follow * owns[:, None]) @ place
            yield source, chain.mT @ pulls.permute(1, 0, 2).flatten(1).double(), owns


def _places(thinned: ThinnedProblem) -> Float[Tensor, "c q"]:
    """Return one where a cell lies in a part of the image, else zero."""
    across, down = PLACES
    camera = thinned.camera
    pixels = thinned.pixels
    x, y = (pixels / pixels.new_tensor([camera.width, camera.height])).mT
    at = (y * down).long() * across + (x * across).long()
    return torch.nn.functional.one_hot(at, across * down).to(pixels)


def pose_covariance(problem: AnyProblem, H: Float[Tensor, "m m"]) -> Float[Tensor, "m m"]:
    """Invert a reduced camera system over all poses; zero for the fixed ones.

    Infinite where it is singular. If at most one pose is fixed, the unit of length is fixed, too.
    """
    fixed = ~problem.free_pose.cpu()
    free = torch.nonzero(~fixed.repeat_interleave(6))[:, 0]
    S = H[free[:, None], free]  # changed in place: 26 MiB for three hundred poses
    if int(fixed.sum()) <= 1:
        origin = int(torch.nonzero(fixed)[0, 0]) if bool(fixed.any()) else 0
        along = _scaling(problem.T_cw.double().cpu(), origin)[free]
        S.addr_(along, along, alpha=1e3 * float(H.diagonal().max()))
    # Undetermined unknowns are no error: their variance becomes very large.
    S.diagonal().add_(1e-9 * (S.diagonal().abs() + 1e-6))
    S, failed = torch.linalg.cholesky_ex(S)
    S = torch.full_like(S, torch.inf) if int(failed) else torch.cholesky_inverse(S)
    covariance = torch.zeros_like(H)
    covariance[free[:, None], free] = S
    return covariance


def _normalised_residual(
    problem: AnyProblem, thinned: ThinnedProblem, options: BundleOptions
) -> Float[Tensor, "n"]:
    """Return the median residual from each frame; infinite without matches.

    Matches are weighted by their information. On a bare wall the flow continues its surroundings,
    so its residuals are small however badly the others fit: unweighted, an image would seem to fit
    better the more of it is bare.
    """
    found = torch.full((len(problem.T_cw),), torch.inf)
    for part in thinned.parts(options):
        i, j = part.source, part.target
        T_ji = relative_motion(part.T_cw, i, j)
        at = project(thinned.camera, thinned.rays, T_ji, part.inverse_depth[i])
        norm = residual_norms(at, part.pixels, part.weight)
        used = at.valid & (part.weight[..., 0] > 0)
        for frame, edges in sources_within(i):
            own = used[edges]
            if bool(own.any()):
                information = part.weight[edges].sum(-1)[own].double()
                found[frame] = weighted_median(norm[edges][own], information)
    return found


def _scaling(T_cw: Float[Tensor, "n 4 4"], origin: int) -> Float[Tensor, "m"]:
    """Return the unit step of all poses that scales their distances from one camera."""
    away = T_cw[:, :3, :3] @ se3_inverse(T_cw[origin])[:3, 3] + T_cw[:, :3, 3]
    along = torch.cat([away, torch.zeros_like(away)], 1).reshape(-1)
    return along / along.norm().clamp(min=1e-12)


def _depth_variance(source: SourceFlow, covariance: Float[Tensor, "m m"]) -> Float[Tensor, "c"]:
    """Return variances of a source's inverse depths, by its matches and its poses' covariance."""
    depth = source.edges.depth
    rows = source.edges.rows(len(covariance) // 6)
    E = source.edges.chained_coupling()
    among = covariance[rows[:, None], rows].to(E)
    through_poses = (E * (among @ E)).sum(0) / depth.curvature.square()
    return torch.where(depth.information > 0, ALIKE / depth.curvature + through_poses, torch.inf)


class PoseDeviations(NamedTuple):
    """Standard deviations of poses, all axes together."""

    position: Float[Tensor, "n"]
    """Deviation of each camera's centre, in the unit of the poses."""
    rotation: Float[Tensor, "n"]
    """Deviation of each orientation, radians."""


def deviations_after_alignment(
    T_cw: Float[Tensor, "n 4 4"], covariance: Float[Tensor, "m m"]
) -> PoseDeviations:
    """Compute deviations of poses after removing the similarity that fits their errors best.

    A trajectory is compared in this way with the truth, which has its own frame and unit. The
    result does not depend on the pose and the length that were fixed for the covariance.

    Args:
        T_cw: world to camera, float64.
        covariance: of the left perturbations (translation, then rotation) of all poses, m = 6n;
            where it is not finite, deviations are infinite.

    To first order, a perturbation moves a centre c by -R^T tau, and alignment removes from the
    shifts of all centres their projection on those of a Sim(3), (I, -[c]x, c); from the rotations
    in the world, -R^T phi, their mean, as the best-fitting rotation does.
    """
    n = len(T_cw)
    R_wc = T_cw[:, :3, :3].mT
    both = covariance.reshape(n, 2, 3, n, 2, 3)
    moves, turns = (
        torch.einsum("iab,ibjc,jdc->iajd", R_wc, both[:, k, :, :, k], R_wc).reshape(3 * n, 3 * n)
        for k in (0, 1)
    )
    centres = se3_inverse(T_cw)[:, :3, 3]
    centres = centres - centres.mean(0)
    eye = torch.eye(3).to(T_cw).expand(n, 3, 3)
    similarity = torch.cat([eye, -so3_hat(centres), centres[..., None]], 2).reshape(3 * n, 7)
    return PoseDeviations(_left_over(moves, similarity), _left_over(turns, eye.reshape(3 * n, 3)))


def _left_over(covariance: Float[Tensor, "m m"], J: Float[Tensor, "m k"]) -> Float[Tensor, "n"]:
    """Return the deviation of each three numbers after removing the projection on J's columns."""
    if not bool(covariance.isfinite().all()):
        return covariance.new_full((len(covariance) // 3,), torch.inf)
    Q, strength, _ = torch.linalg.svd(J, full_matrices=False)
    # Cameras on a line can be rotated about it freely, cameras at one position only translated.
    Q = Q[:, strength > 1e-9 * strength.max()]
    rest = covariance - Q @ (Q.mT @ covariance)
    variance = rest.diagonal() - ((rest @ Q) * Q).sum(1)
    return variance.reshape(-1, 3).sum(1).clamp(min=0).sqrt()
