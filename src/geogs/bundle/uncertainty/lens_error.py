"""What matches say of the error of a lens, and what it costs the poses.

A lens that bends by a thousandth lets every keyframe of a walk straight on seem a little shorter
than the one before it: what lies ahead moves outwards, where it is magnified otherwise. All matches
of a video say so alike, and neither their residuals nor more of them tell; but the error is of a
known shape. Its sizes (:data:`SHAPES`) are unknowns that the poses and depths are eliminated from.
They are estimated, and what is left open of them is considered in what is said of poses.
Source: self-calibration in the adjustment (Brown 1971), consider analysis (Bierman 1977).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.flow_term import linearised_sources
from geogs.bundle.lens_flow import LensFlow
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import CellProjection, carried_over, project, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.terms import BundleState
from geogs.bundle.uncertainty.marginals import Considered, pose_covariance
from geogs.bundle.uncertainty.thinned import AnyProblem, ThinnedProblem
from geogs.geometry.camera import Camera
from geogs.world.grid import SampleGrid

RADIAL = 3
"""Shapes of the error of a pixel x off the axis: x, x |x|^2, x |x|^4, for the logarithm of the
focal length, and OpenCV's k1 and k2."""
SHAPES = RADIAL + 2
"""And one along either side of the image, for the principal point, in focal lengths."""
Rows = Callable[[BundleProblem, Float[Tensor, "p 3"], CellProjection], Float[Tensor, "e p 2"]]
"""What is to be added to where cells of a problem's edges were found for a readout that is longer
by a part of it: one shape more."""
LEAST, LEAST_OF_READOUT = (0.0005, 0.0005, 0.001, 0.001, 0.002), 0.005
"""No size is known better, however many matches agree: half of what they say of lenses that have no
error (docs/notebook/lens.md)."""
PRIOR = 0.03, 0.05, 0.1
"""Deviations of the radial sizes before any match is asked."""
CENTRE, GIVEN_CENTRE = 0.03, 0.002
"""Deviation of the principal point, of a lens that nobody measured and of one that somebody did."""
STANDARD_ERRORS = 3.0
"""Standard errors of the matches' own estimate that are taken for a deviation of the lens: matches
of different keyframes err alike, too. Errors are 1 to 7 of them in rendered rooms."""
FOCAL_LEFT = 0.05
"""What the focal length is off by after its correction, of the correction, whatever matches say: 0
to 9 % where it was corrected by a fifth to a half (docs/notebook/lens.md)."""
PARTS, SURE = 6, 5.0
"""Parts of a video whose focal lengths are compared; deviations by which they differ by chance."""


def lens_prior(focal_deviation: float = 0.0) -> tuple[float, ...]:
    """Deviations of the sizes before any match is asked, of a focal length that is known to a
    relative ``focal_deviation``, which may be a guess; 0 where somebody said it."""
    centre = CENTRE if focal_deviation > 0 else GIVEN_CENTRE
    return max(focal_deviation, PRIOR[0]), PRIOR[1], PRIOR[2], centre, centre


def lens_shapes(camera: Camera, pixels: Float[Tensor, "*b 2"]) -> Float[Tensor, "5 *b 2"]:
    """Offset of the camera's pixel from what is seen, for each size of one, to first order."""
    focal, plane = pixels.new_tensor([camera.fx, camera.fy]), camera.plane(pixels)
    off, flat = pixels - pixels.new_tensor([camera.cx, camera.cy]), focal * plane
    square = plane.square().sum(-1, keepdim=True)
    right, down = torch.zeros_like(off), torch.zeros_like(off)
    right[..., 0], down[..., 1] = camera.fx, camera.fy
    return torch.stack([-off, -flat * square, -flat * square.square(), -right, -down])


def shape_shifts(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_ji: Float[Tensor, "e 4 4"],
    at: CellProjection,
    sizes: Float[Tensor, "m 5"],
) -> Float[Tensor, "m e p 2"]:
    """What is to be added to where cells were found, for each of some errors of these sizes.

    What a cell shows lies off it, and so does what is found in the target; the former is carried
    over at the cell's own depth. The latter is taken where the cell falls (``at``): where it was
    found is off by the residual, and the product of both would count as evidence.
    """
    there, here = (
        torch.einsum("mk,k...->m...", sizes, lens_shapes(camera, p))
        for p in (at.pixels, _own_pixels(camera, rays))
    )
    return there - carried_over(camera, rays, T_ji, at, here[:, None].expand_as(there))


def shifts_of_edges(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_ji: Float[Tensor, "e 4 4"],
    at: CellProjection,
    sizes: Float[Tensor, "e 2 5"],
) -> Float[Tensor, "e p 2"]:
    """The same for one error of each edge's source and one of its target."""
    there = torch.einsum("ek,kepc->epc", sizes[:, 1], lens_shapes(camera, at.pixels))
    own = lens_shapes(camera, _own_pixels(camera, rays))
    here = torch.einsum("ek,kpc->epc", sizes[:, 0], own)
    return there - carried_over(camera, rays, T_ji, at, here)


def _own_pixels(camera: Camera, rays: Float[Tensor, "p 3"]) -> Float[Tensor, "p 2"]:
    """Where cells with these rays are."""
    own = rays.new_tensor([camera.fx, camera.fy]) * camera.bent(rays[:, :2])
    return own + rays.new_tensor([camera.cx, camera.cy])


@dataclass(frozen=True)
class LensEvidence:
    """Normal equations of the sizes of a lens' error, poses and depths eliminated."""

    information: Float[Tensor, "s k k"]
    """Information of each source frame; their sum is that of all."""
    gradient: Float[Tensor, "s k"]
    """The direction of descent; likewise."""
    moves: Float[Tensor, "m k"]
    """Moves of all poses by an error of size one, left perturbations; m = 6n."""
    depth_moves: Float[Tensor, "n c k"]
    """Moves of the inverse depths of some cells of each frame, as fractions of these; none (c = 0)
    where nobody asked."""

    def joined(self, other: "LensEvidence") -> "LensEvidence":
        """The evidence of both, poses of one after those of the other."""
        return LensEvidence(
            torch.cat([self.information, other.information]),
            torch.cat([self.gradient, other.gradient]),
            torch.cat([self.moves, other.moves]),
            torch.cat([self.depth_moves, other.depth_moves]),
        )

    @property
    def bend(self) -> "LensEstimate":
        """Estimate of k1 and k2, focal length and principal point being right."""
        return self._of(range(1, RADIAL))

    def agreement(self, other: "LensEvidence") -> float:
        """Cross-validation of k1 and k2 between two parts of a video: by what fraction of the most
        that is possible either's estimate lowers the other's cost, at least; 1 at most."""
        return min(self._validated(other), other._validated(self))

    def _validated(self, other: "LensEvidence") -> float:
        """Fraction of the largest decrease of the cost that the other's k1 and k2 reach."""
        information = self.information.sum(0)[1:RADIAL, 1:RADIAL]
        gradient = self.gradient.sum(0)[1:RADIAL]

        def decrease(size: Float[Tensor, "2"]) -> float:
            return float(2 * gradient @ size - size @ information @ size)

        best = decrease(self.bend.size)
        return decrease(other.bend.size) / best if best > 0 else 0.0

    @property
    def focal_change(self) -> float:
        """Difference of the focal lengths that parts of the video want, as a fraction of them,
        beyond what each leaves open; 0 where they agree.

        Each by its own residuals, poses and depths as all want them together. Where somebody zooms
        these are hard to explain by one lens, however well each part is explained by itself.
        """
        parts = torch.tensor_split(torch.arange(len(self.gradient)), PARTS)
        found = [
            _estimate(self.information[part, :1, :1], self.gradient[part, :1])
            for part in parts
            if len(part) > 1 and bool(self.information[part, 0, 0].sum() > 0)
        ]
        if len(found) < 2:
            return 0.0
        size = torch.cat([each.size for each in found])
        deviation = torch.cat([each.deviation for each in found])
        ends = torch.stack([size.argmax(), size.argmin()])
        most, least = size[ends].tolist()
        return max(0.0, most - least - SURE * float(deviation[ends].norm()))

    def whole(self, with_centre: bool = True) -> "LensEstimate":
        """Estimate of all sizes together, but for those of a principal point that is right."""
        every = range(self.gradient.shape[1])
        return self._of([n for n in every if with_centre or not RADIAL <= n < SHAPES])

    def _of(self, asked: Sequence[int]) -> "LensEstimate":
        """Estimate of some sizes, the others being right."""
        sizes = list(asked)
        information = self.information[:, sizes][:, :, sizes]
        least = tuple((*LEAST, LEAST_OF_READOUT)[n] for n in sizes)
        return _estimate(information, self.gradient[:, sizes]).floored(least)

    def considered(
        self, corrected: float = 1.0, doubt: float = 0.0, focal_deviation: float = 0.0
    ) -> Considered:
        """Second moments of what the error of the lens does to poses and depths.

        The matches' estimate is combined with the prior (:func:`lens_prior`). Poses and depths move
        by the estimate, as if it were taken off, and by what it leaves open; besides by what is
        left of a focal length that was ``corrected`` by a factor, which matches do not tell of.
        ``doubt`` is the deviation of a readout that is one more size, as a fraction of it.
        ``LEAST`` is not added: errors that matches have in common pass for one of the lens that
        hardly moves a pose, and three sizes of such deviations would move poses two to five times
        as far.
        """
        said = _estimate(self.information, self.gradient)
        expected = (*lens_prior(focal_deviation), doubt)
        prior = self.moves.new_tensor(expected[: len(said.size)]).square()
        gain = torch.diag(prior) @ torch.linalg.inv(torch.diag(prior) + said.covariance)
        size = gain @ said.size
        left = torch.diag(prior) - gain @ torch.diag(prior)
        left[0, 0] += (FOCAL_LEFT * math.log(corrected)) ** 2
        square = left + size[:, None] * size
        depth = self.depth_moves.to(square)
        return Considered(
            self.moves @ square @ self.moves.mT,
            ((depth @ square) * depth).sum(-1).float(),
            float(square[0, 0]),
        )


class LensEstimate(NamedTuple):
    """Sizes of a lens' error, and their covariance."""

    size: Float[Tensor, "k"]
    covariance: Float[Tensor, "k k"]

    @property
    def deviation(self) -> Float[Tensor, "k"]:
        """Standard deviation of each size."""
        return self.covariance.diagonal().sqrt()

    def without(self, size: int) -> "LensEstimate":
        """The estimate of the others where one is known to be zero."""
        known, left = self.told(size, 0.0, 0.0), torch.arange(len(self.size)) != size
        return LensEstimate(known.size[left], known.covariance[left][:, left])

    def told(self, size: int, value: float, deviation: float) -> "LensEstimate":
        """The estimate with what was known of one size before: a value and its deviation."""
        column = self.covariance[:, size]
        gain = column / (column[size] + deviation**2)
        moved = self.size + gain * (value - self.size[size])
        return LensEstimate(moved, self.covariance - gain[:, None] * column)

    def shortened(self, size: int, most: float) -> "LensEstimate":
        """The sizes as far as one of them goes no farther than that."""
        part = (most / self.size[size].abs()).clamp(max=1)
        return LensEstimate(part * self.size, self.covariance)

    def floored(self, least: tuple[float, ...]) -> "LensEstimate":
        """With no size known better than so."""
        floor = torch.diag(self.size.new_tensor(least).square())
        return LensEstimate(self.size, self.covariance + floor)

    def of(self, sizes: slice) -> "LensEstimate":
        """Some of the sizes, whatever the others are."""
        return LensEstimate(self.size[sizes], self.covariance[sizes, sizes])

    @property
    def evidence(self) -> float:
        """Square of the sizes in their deviations."""
        return float(self.size @ torch.linalg.solve(self.covariance, self.size))


def _estimate(each: Float[Tensor, "s k k"], gradient: Float[Tensor, "s k"]) -> LensEstimate:
    """The sizes that matches want, and their covariance.

    That is what the matches themselves leave open, and a cluster-robust one beside, by source
    frames (Liang and Zeger's sandwich, as in :func:`~geogs.bundle.shared.solve_shared`): it is
    the larger by far where there is evidence, and nothing where there is none.
    """
    information = each.sum(0)
    damping = torch.diag(1e-9 * information.diagonal() + 1e-12)
    inverse = torch.linalg.inv(information + damping)
    size = inverse @ gradient.sum(0)
    left = gradient - each @ size
    return LensEstimate(size, inverse + inverse @ left.mT @ left @ inverse)


def lens_evidence(
    grid: SampleGrid,
    problem: AnyProblem,
    options: BundleOptions,
    cells: int = 1024,
    rows: Rows | None = None,
    of_depths: bool = False,
) -> LensEvidence | None:
    """What the matches of a problem at its solution say of the error of the lens.

    None where they do not tell of all poses.

    Args:
        grid: where the depths are.
        problem: as of :func:`~geogs.bundle.uncertainty.marginals.marginals`; it is linearised once.
        options: Huber's limit and the damping of depths.
        cells: most cells of a frame that are asked; the others are taken to say the same.
        rows: shape of an error of the readout, which is the last size then.
        of_depths: whether to tell by how much depths move, too.
    """
    thinned = ThinnedProblem(grid, problem, cells)
    scale = 1 / thinned.fraction
    size, shapes = 6 * len(problem.T_cw), SHAPES + (rows is not None)
    poses, pull = (torch.zeros(size, width, dtype=torch.float64) for width in (size, shapes))
    each = list(_reduced(thinned, options, rows))
    for s in each:
        poses[s.rows[:, None], s.rows] += scale * s.poses
        pull[s.rows] += scale * s.pull
    covariance = pose_covariance(problem, poses)
    if not bool(covariance.isfinite().all()):
        return None
    moves = covariance @ pull
    information = [s.information - s.pull.mT @ moves[s.rows] for s in each]
    gradient = [s.gradient + moves[s.rows].mT @ s.descent for s in each]
    depth = torch.zeros(len(problem.T_cw), thinned.count * of_depths, shapes)
    if of_depths:
        for s, source in zip(each, thinned.sources(options), strict=True):
            depth[source.frame] = thinned.depth_moves(source, s.on_depth.mT, moves)
    return LensEvidence(
        scale * torch.stack(information), scale * torch.stack(gradient), moves, depth
    )


class _Reduced(NamedTuple):
    """Equations of the poses that a source joins, and of the sizes, its depths eliminated."""

    rows: Int[Tensor, "c"]
    poses: Float[Tensor, "c c"]
    pull: Float[Tensor, "c k"]
    """Gradient on the poses of matches that are off by a size of one."""
    descent: Float[Tensor, "c"]
    """Gradient of the residuals on the poses."""
    on_depth: Float[Tensor, "k p"]
    """Gradient on the depths of matches that are off by a size of one."""
    information: Float[Tensor, "k k"]
    gradient: Float[Tensor, "k"]
    """Direction of descent of the sizes, poses being fixed."""


def _reduced(
    thinned: ThinnedProblem, options: BundleOptions, rows: Rows | None
) -> Iterator[_Reduced]:
    """Each source in order. What is to be added to a match is what the lens takes off where its
    cell falls: so are the signs of what joins sizes and poses or depths."""

    def fallen(part: BundleProblem) -> Float[Tensor, "e o p 2"]:
        T_ji = relative_motion(part.T_cw, part.source, part.target)
        at = project(thinned.camera, thinned.rays, T_ji, part.inverse_depth[part.source])
        centre = torch.eye(SHAPES).to(at.pixels)[RADIAL:]
        moved = [*shape_shifts(thinned.camera, thinned.rays, T_ji, at, centre)]
        if rows is not None:
            moved.append(rows(part, thinned.rays, at))
        return -torch.stack(moved, 1)

    flow = LensFlow(further=fallen)
    for part in thinned.parts(options):
        state = BundleState(part.T_cw, part.inverse_depth, thinned.lens)
        for source in linearised_sources(flow, part, state, options):
            edges = source.edges
            hessian, gradient = edges.chained()
            c = len(gradient) - edges.shared
            yield _Reduced(
                edges.rows(len(part.T_cw))[:c],
                hessian[:c, :c],
                -hessian[:c, c:],
                gradient[:c],
                -source.depth.coupling[-edges.shared :],
                hessian[c:, c:],
                gradient[c:],
            )
