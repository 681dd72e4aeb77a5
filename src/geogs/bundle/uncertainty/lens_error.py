"""Error of a lens estimated from matches, and its effect on the poses.

With a distortion error of a thousandth every step of a straight walk seems a little shorter than
the one before it: points ahead move outwards, where the magnification differs. All matches of a
video have this error, so neither residuals nor more matches reveal it; but its shape is known. Its
sizes (:data:`SHAPES`) are unknowns from which poses and depths are eliminated. They are estimated,
and their remaining errors are considered in the uncertainty of poses.
Source: self-calibration in the adjustment (Brown 1971), consider analysis (Bierman 1977).
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.lens_flow import LensFlow
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import CellProjection, carried_over, project, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.uncertainty.marginals import Considered, pose_covariance
from geogs.bundle.uncertainty.thinned import AnyProblem, ThinnedProblem
from geogs.geometry.camera import Camera
from geogs.world.grid import SampleGrid

RADIAL = 3
"""Number of radial shapes of the error at x from the axis: x, x |x|^2, x |x|^4, for the logarithm
of the focal length, and OpenCV's k1 and k2."""
SHAPES = RADIAL + 2
"""All shapes: also one along either side of the image for the principal point, in focal lengths."""
Rows = Callable[[BundleProblem, Float[Tensor, "p 3"], CellProjection], Float[Tensor, "e p 2"]]
"""Returns the shifts of a problem's matches per relative change of the readout: one more shape."""
LEAST = 0.0005, 0.0005, 0.001, 0.001, 0.002, 0.005
"""Least deviation of each size, and of the readout's, however many matches agree: half of the sizes
estimated for lenses without error (docs/notebook/lens.md)."""
PRIOR = 0.03, 0.05, 0.1
"""Prior deviations of the radial sizes."""
CENTRE, GIVEN_CENTRE = 0.03, 0.002
"""Prior deviation of the principal point of an uncalibrated and of a calibrated lens."""
STANDARD_ERRORS = 3.0
"""Deviation of the lens in standard errors of the matches' estimate, as errors of different
keyframes are correlated, too. Errors are 1 to 7 of them in rendered rooms."""
FOCAL_LEFT = 0.05
"""Remaining error of the focal length after its correction, as a fraction of the correction: 0 to
9 % where it was corrected by a fifth to a half (docs/notebook/lens.md)."""
PARTS, SURE = 6, 5.0
"""Parts of a video whose focal lengths are compared, and difference in deviations due to chance."""


def lens_prior(focal_deviation: float = 0.0) -> tuple[float, ...]:
    """Return prior deviations of the sizes, for a focal length with a relative ``focal_deviation``
    if it was estimated or guessed; 0 if it was given."""
    centre = CENTRE if focal_deviation > 0 else GIVEN_CENTRE
    return max(focal_deviation, PRIOR[0]), PRIOR[1], PRIOR[2], centre, centre


def lens_shapes(camera: Camera, pixels: Float[Tensor, "*b 2"]) -> Float[Tensor, "5 *b 2"]:
    """Return the pixel offset for each shape with size one, to first order."""
    focal = pixels.new_tensor([camera.fx, camera.fy])
    plane = camera.plane(pixels)
    off = pixels - pixels.new_tensor([camera.cx, camera.cy])
    flat = focal * plane
    _, by_k1, by_k2 = camera.radial_shapes(plane.square().sum(-1, keepdim=True))
    right, down = torch.zeros_like(off), torch.zeros_like(off)
    right[..., 0] = camera.fx
    down[..., 1] = camera.fy
    return torch.stack([-off, -flat * by_k1, -flat * by_k2, -right, -down])


def shifts_of_edges(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_ji: Float[Tensor, "e 4 4"],
    at: CellProjection,
    sizes: Float[Tensor, "e 2 5"],
) -> Float[Tensor, "e p 2"]:
    """Return shifts of matches for one error of each edge's source and one of its target.

    The content of a cell is offset from it, and so is its match in the target; the former offset is
    propagated at the cell's depth. The latter is evaluated at the cell's projection (``at``): the
    match itself is off by the residual, and the product of both would count as evidence.
    """
    there = torch.einsum("ek,kepc->epc", sizes[:, 1], lens_shapes(camera, at.pixels))
    own = lens_shapes(camera, camera.pixels(rays[:, :2]))
    here = torch.einsum("ek,kpc->epc", sizes[:, 0], own)
    return there - carried_over(camera, rays, T_ji, at, here)


class LensEvidence(NamedTuple):
    """Normal equations of the sizes of a lens' error, poses and depths eliminated."""

    information: Float[Tensor, "s k k"]
    """Information of each source frame; the sum is that of all."""
    gradient: Float[Tensor, "s k"]
    """Direction of descent of each source frame."""
    moves: Float[Tensor, "m k"]
    """Changes of all poses by an error of size one, left perturbations; m = 6n."""
    depth_moves: Float[Tensor, "n c k"]
    """Relative changes of the inverse depths of some cells of each frame; c = 0 if not
    requested."""

    def joined(self, other: "LensEvidence") -> "LensEvidence":
        """Concatenate the evidence of both, poses of one after those of the other."""
        return LensEvidence(*(torch.cat(pair) for pair in zip(self, other, strict=True)))

    @property
    def bend(self) -> "LensEstimate":
        """Estimate of k1 and k2, with focal length and principal point fixed."""
        return self._of(range(1, RADIAL))

    def agreement(self, other: "LensEvidence") -> float:
        """Cross-validate k1 and k2 between two parts of a video: decrease of either's cost by the
        other's estimate, as a fraction of the largest possible; the smaller of both, at most 1."""
        return min(self._validated(other), other._validated(self))

    def _validated(self, other: "LensEvidence") -> float:
        """Return the fraction of the largest decrease of the cost by the other's k1 and k2."""
        information = self.information.sum(0)[1:RADIAL, 1:RADIAL]
        gradient = self.gradient.sum(0)[1:RADIAL]

        def decrease(size: Float[Tensor, "2"]) -> float:
            return float(2 * gradient @ size - size @ information @ size)

        best = decrease(self.bend.size)
        return decrease(other.bend.size) / best if best > 0 else 0.0

    @property
    def focal_change(self) -> float:
        """Relative difference of the focal lengths that fit parts of the video best, beyond their
        deviations; 0 where they agree.

        Each is estimated from the part's own residuals, with the poses and depths of all. If the
        lens zooms, one lens does not explain them, however well each part is explained alone.
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
        """Estimate all sizes together, optionally without the principal point."""
        every = range(self.gradient.shape[1])
        return self._of([n for n in every if with_centre or not RADIAL <= n < SHAPES])

    def _of(self, asked: Sequence[int]) -> "LensEstimate":
        """Estimate some sizes, the others being zero."""
        sizes = list(asked)
        information = self.information[:, sizes][:, :, sizes]
        found = _estimate(information, self.gradient[:, sizes])
        least = found.size.new_tensor([LEAST[n] for n in sizes])
        return found._replace(covariance=found.covariance + torch.diag(least.square()))

    def considered(
        self, corrected: float = 1.0, doubt: float = 0.0, focal_deviation: float = 0.0
    ) -> Considered:
        """Return second moments of the changes of poses and depths due to the error of the lens.

        The matches' estimate is combined with the prior (:func:`lens_prior`). Poses and depths
        change by the estimate, as if the matches were corrected for it, and by its covariance; also
        by the remaining error of a focal length that was ``corrected`` by a factor, which matches
        do not determine. ``doubt`` is the relative deviation of a readout, one more size. ``LEAST``
        is not added: common errors of matches look like a lens error that hardly changes a pose,
        and three sizes of such deviations would change poses two to five times as much.
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
        """Return the estimate of the other sizes, given that one is zero."""
        known = self.told(size, 0.0, 0.0)
        left = torch.arange(len(self.size)) != size
        return LensEstimate(known.size[left], known.covariance[left][:, left])

    def told(self, size: int, value: float, deviation: float) -> "LensEstimate":
        """Return the estimate updated by a prior on one size: a value and its deviation."""
        column = self.covariance[:, size]
        gain = column / (column[size] + deviation**2)
        moved = self.size + gain * (value - self.size[size])
        return LensEstimate(moved, self.covariance - gain[:, None] * column)

    def shortened(self, size: int, most: float) -> "LensEstimate":
        """Scale all sizes down so that one of them is at most ``most``."""
        part = (most / self.size[size].abs()).clamp(max=1)
        return LensEstimate(part * self.size, self.covariance)

    def of(self, sizes: slice) -> "LensEstimate":
        """Return the marginal estimate of some of the sizes."""
        return LensEstimate(self.size[sizes], self.covariance[sizes, sizes])

    @property
    def evidence(self) -> float:
        """Squared Mahalanobis distance of the sizes from zero."""
        return float(self.size @ torch.linalg.solve(self.covariance, self.size))


def _estimate(each: Float[Tensor, "s k k"], gradient: Float[Tensor, "s k"]) -> LensEstimate:
    """Estimate the sizes from matches, with their covariance.

    The covariance is the inverse of the information plus a cluster-robust one, by source frames
    (Liang and Zeger's sandwich, as in :func:`~geogs.bundle.shared.solve_shared`): the latter is
    the larger by far where there is evidence, and zero where there is none.
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
    """Compute the evidence of a problem's matches, at its solution, on the error of the lens.

    None where they do not determine all poses.

    Args:
        grid: of the depths.
        problem: as for :func:`~geogs.bundle.uncertainty.marginals.marginals`; linearised once.
        options: Huber threshold and the damping of depths.
        cells: most cells of a frame that are used; they represent the others.
        rows: shape of an error of the readout, which is then the last size.
        of_depths: whether to compute the changes of depths, too.
    """
    thinned = ThinnedProblem(grid, problem, cells)
    scale = 1 / thinned.fraction
    n = len(problem.T_cw)
    shapes = SHAPES + (rows is not None)
    poses = torch.zeros(6 * n, 6 * n, dtype=torch.float64)
    both = poses.new_zeros(6 * n, shapes)
    equations = []
    on_depths = []
    for source in thinned.sources(options, LensFlow(further=partial(_further, thinned, rows))):
        hessian, gradient = source.edges.chained()
        slots = source.edges.rows(n)[:-shapes]
        c = len(slots)
        poses[slots[:, None], slots] += scale * hessian[:c, :c]
        both[slots] += scale * hessian[:c, c:]
        equations.append((slots, hessian[:, c:], gradient))
        on_depths.append(-source.edges.depth.coupling[-shapes:].mT)
    covariance = pose_covariance(problem, poses)
    if not bool(covariance.isfinite().all()):
        return None
    moves = -covariance @ both
    information = [H[-shapes:] + H[:-shapes].mT @ moves[slots] for slots, H, _ in equations]
    gradients = [g[-shapes:] + moves[slots].mT @ g[:-shapes] for slots, _, g in equations]
    depth = torch.zeros(n, thinned.count * of_depths, shapes)
    if of_depths:
        for source, on_depth in zip(thinned.sources(options), on_depths, strict=True):
            depth[source.frame] = thinned.depth_moves(source, on_depth, moves)
    return LensEvidence(
        scale * torch.stack(information), scale * torch.stack(gradients), moves, depth
    )


def _further(
    thinned: ThinnedProblem, rows: Rows | None, part: BundleProblem
) -> Float[Tensor, "e o p 2"]:
    """Return derivatives of the cells' projections by the sizes that are no parameters of a
    :class:`~geogs.bundle.lens.LensBlock`: the principal point, and the readout."""
    camera = thinned.camera
    T_ji = relative_motion(part.T_cw, part.source, part.target)
    at = project(camera, thinned.rays, T_ji, part.inverse_depth[part.source])
    there = lens_shapes(camera, at.pixels)[RADIAL:]
    here = lens_shapes(camera, camera.pixels(thinned.rays[:, :2]))[RADIAL:]
    here = carried_over(camera, thinned.rays, T_ji, at, here[:, None].expand_as(there))
    moved = [*(there - here)]
    if rows is not None:
        moved.append(rows(part, thinned.rays, at))
    # A shift added to a match is subtracted from the cell's projection.
    return -torch.stack(moved, 1)
