"""The focal length by the epipolar geometry of many pairs of views, which needs no poses.

Where views cannot be placed one after the other, or their chain is too short to show depth, pairs
of them still tell: seven numbers of a fundamental matrix are five of a motion and two of a camera.
Each pair starts from its own fundamental matrix, at several focal lengths; then the essential
matrices of all pairs and the one focal length they share are adjusted together (a view graph that
is calibrated by what its matches say, not by its matrices: a pair that tells nothing has no say).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from geogs.bundle.lens import RadialLens
from geogs.bundle.uncertainty.lens_error import STANDARD_ERRORS
from geogs.geometry.camera import Camera
from geogs.geometry.least_squares import Policy, Solution, Step, minimise
from geogs.tracking.calibration.epipolar_error import (
    EpipolarState,
    MatchedPairs,
    errors,
    linearised,
)
from geogs.tracking.calibration.focal_uncertainty import FIELDS_OF_VIEW, Estimate
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

LEAST_PAIRS = 12
"""Fewer pairs that show more than a plane or a rotation are not believed."""
LEAST_DEVIATION = 0.02
"""Relative. What rows that are read one after the other and a lens that bends do to pairs of views
they do to all of them alike, so that no spread shows it: 1.5 to 4.6 % where simulated."""
DISTORTION_FRACTION = 0.5
"""Fraction of the change of the focal length if the lens may bend that counts as deviation: it is
taken for a pinhole here."""
_STARTS = (30.0, 45.0, 60.0, 80.0, 105.0)
"""Degrees along the longer side."""
_MATCHES = 300
"""Of a pair, at most; evenly spread ones of more."""
_LEAST_MATCHES = 60
_FLAT = 0.8
"""Matches that obey a homography, of those that obey a fundamental matrix, above which a pair shows
a plane or a rotation: then any of many such matrices would do, and so would any focal length."""
_TOLERANCE = 1 / 400
"""Distance from the epipolar line within which a match agrees with it, of the long edge."""
_FORGIVING = 4.0
"""Scale of Cauchy's loss at first, in that of the end, which is half the tolerance."""
_ROUGH = Policy(max_trials=12, damping=1e-3, max_damping=1e6, retries_unsolvable=True)
_FINE = replace(_ROUGH, max_trials=40, least_decrease=1e-5)


def view_graph_estimate(camera: Camera, flows: Sequence[tuple[int, FlowMatch]]) -> Estimate | None:
    """The focal length that best explains flows between pairs of views.

    ``flows`` are single edges with the number of the view that they start from: what starts from
    one view counts as one witness for the deviation. Of the camera only size, aspect and principal
    point count. None where too few pairs show parallax, or what comes out is no pinhole camera.
    """
    found = [(n, *pair) for n, match in flows if (pair := _pair(camera, match)) is not None]
    if len(found) < LEAST_PAIRS:
        return None
    witness = torch.tensor([n for n, *_ in found])
    pairs = _padded([matches for _, matches, _ in found])
    matrices = np.stack([F for *_, F in found])
    sigma = camera.long_edge * _TOLERANCE / 2
    starts = [_start(matrices, camera.with_field_of_view(angle).fx) for angle in _STARTS]
    rough = [_adjusted(pairs, start, _FORGIVING * sigma, _ROUGH) for start in starts]
    best = min(rough, key=lambda solution: solution.cost)
    state = _adjusted(pairs, best.state, sigma, _FINE).state
    deviation, deviation_k1 = _deviations(pairs, state, sigma, witness)
    result = camera.with_focal(float(state.log_focal.exp()))
    widest, narrowest = (camera.with_field_of_view(angle).fx for angle in FIELDS_OF_VIEW[::-1])
    if not widest < result.fx < narrowest:
        return None
    covariance = torch.tensor([deviation**2, deviation_k1**2, 0.0], dtype=torch.float64).diag()
    return Estimate(RadialLens(result), covariance, len(witness.unique()))


def _pair(
    camera: Camera, match: FlowMatch
) -> tuple[Float64[np.ndarray, "n 4"], Float64[np.ndarray, "3 3"]] | None:
    """Matches of a pair from the principal point on, and its fundamental matrix (MAGSAC); None
    where it has too few, or a homography explains them."""
    match, tolerance = match.on_cpu(), camera.long_edge * _TOLERANCE
    used = np.flatnonzero(match.sure()[0].numpy())
    used = used[:: -(-len(used) // _MATCHES) or 1]
    if len(used) < _LEAST_MATCHES:
        return None
    ends = SampleGrid(camera).pixels, match.pixels[0]
    centre, square = np.array([camera.cx, camera.cy]), np.array([1.0, camera.fx / camera.fy])
    p, q = ((end.double().numpy()[used] - centre) * square for end in ends)
    try:
        F, agree = cv2.findFundamentalMat(p, q, cv2.USAC_MAGSAC, tolerance, 0.999, 2000)
        H, planar = cv2.findHomography(p, q, cv2.USAC_MAGSAC, tolerance)
    except cv2.error:  # OpenCV 5 fails an assertion where no sample gives a model
        return None
    if F is None or F.shape != (3, 3):
        return None
    is_flat = H is not None and planar.sum() > _FLAT * agree.sum()
    return None if is_flat else (np.c_[p, q], F)


def _padded(matches: Sequence[Float64[np.ndarray, "_ 4"]]) -> MatchedPairs:
    most = max(map(len, matches))
    full = np.stack([np.pad(m, ((0, most - len(m)), (0, 0)), "wrap") for m in matches])
    weight = np.stack([np.arange(most) < len(m) for m in matches]).astype(float)
    ends = torch.from_numpy(full)
    return MatchedPairs(ends[..., :2], ends[..., 2:], torch.from_numpy(weight))


def _start(matrices: Float64[np.ndarray, "k 3 3"], focal: float) -> EpipolarState:
    """The essential matrices nearest to fundamental ones; which of the poses, is no matter."""
    K = np.diag([focal, focal, 1.0])
    U, _, Vt = np.linalg.svd(K @ matrices @ K)
    U, Vt = (m * np.sign(np.linalg.det(m))[:, None, None] for m in (U, Vt))
    R = U @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ Vt
    log_focal = torch.tensor(math.log(focal), dtype=torch.float64)
    return EpipolarState(torch.from_numpy(R), torch.from_numpy(U[..., 2].copy()), log_focal)


@dataclass(frozen=True)
class _Normal:
    """Normal equations of all pairs: of the numbers of each, and of what they share."""

    H: Float64[Tensor, "k 7 7"]
    g: Float64[Tensor, "k 7"]

    def reduced(self, damping: float) -> tuple[Tensor, Tensor, Tensor]:
        """What each pair says of log focal and k1, its own numbers eliminated (Schur complement):
        Hessian, gradient, and how its numbers follow (the last column: where both stay)."""
        own = self.H[:, :5, :5]
        most = own.diagonal(dim1=1, dim2=2).amax(1, keepdim=True)
        damped = own + torch.diag_embed(damping * own.diagonal(dim1=1, dim2=2) + 1e-9 * most)
        follow = torch.linalg.solve(damped, torch.cat([self.H[:, :5, 5:], self.g[:, :5, None]], -1))
        less = self.H[:, 5:, :5] @ follow
        return self.H[:, 5:, 5:] - less[..., :2], self.g[:, 5:] - less[..., 2], follow


def _normal(pairs: MatchedPairs, state: EpipolarState, sigma: float) -> _Normal:
    error, J = linearised(pairs, state)
    weighted = J * (pairs.weight / (1 + (error / sigma) ** 2))[..., None]
    return _Normal(weighted.mT @ J, (weighted.mT @ error[..., None])[..., 0])


def _adjusted(
    pairs: MatchedPairs, state: EpipolarState, sigma: float, policy: Policy
) -> Solution[EpipolarState, _Normal]:
    """All pairs and log focal under Cauchy's loss of that scale."""

    def step(state: EpipolarState, normal: _Normal, damping: float) -> Step[EpipolarState] | None:
        H, g, follow = normal.reduced(damping)
        change = (-g.sum(0)[0] / H.sum(0)[0, 0]).clamp(-0.3, 0.3)
        own = -follow[..., 2] - follow[..., 0] * change
        return Step(state.moved(own, change)) if own.isfinite().all() else None

    def cost(state: EpipolarState, normal: _Normal) -> float:
        squares = (errors(pairs, state) / sigma).square()
        return float((pairs.weight * squares.log1p()).sum())

    return minimise(state, lambda s: _normal(pairs, s, sigma), step, policy, cost)


def _deviations(
    pairs: MatchedPairs, state: EpipolarState, sigma: float, witness: Tensor
) -> tuple[float, float]:
    """Of log focal, and of a k1 that is taken for none; robust to clusters (a sandwich)."""
    H, g, _ = _normal(pairs, state, sigma).reduced(0.0)
    H = H.sum(0)
    groups = torch.zeros(int(witness.max()) + 1, 2, dtype=g.dtype).index_add_(0, witness, g)
    inverse = torch.linalg.pinv(H)
    shift, errors_k1 = -inverse @ g.sum(0), groups @ inverse[1]
    error = float(groups[:, 0].norm() / H[0, 0].clamp(min=1e-12))
    bent = DISTORTION_FRACTION * float(shift[0])
    return (
        math.hypot(STANDARD_ERRORS * error, bent, LEAST_DEVIATION),
        math.hypot(STANDARD_ERRORS * float(errors_k1.norm()), float(shift[1])),
    )
