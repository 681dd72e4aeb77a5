"""Uncertainty of focal length and distortion by one stretch of a video, and by several together."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from geogs.bundle.lens import RadialLens
from geogs.geometry.camera import Camera
from geogs.tracking.calibration.degeneracy import MAX_COST, Degeneracy
from geogs.tracking.calibration.growing_bundle import GrowingBundle

STANDARD_ERRORS = 3.0
"""The adjustment's own standard error times this is taken for the deviation: matches of different
keyframes err alike too. Measured on rendered rooms, where errors are 1 to 7 standard errors."""
LEAST_DEVIATION = 0.002
"""Relative: no focal length is known better, however many matches agree; nor are k1 and k2."""
PRIOR = 0.1, 0.2
"""Deviations of k1 and k2 before any match is asked. A narrow field of view does not tell them."""
EVIDENCE = 36.0
"""Square of k1 and k2 in their deviations from which on a lens is believed to bend: 1 to 21 where
it does not or hardly does, 65 and more where it does (docs/calibration.md)."""
DISTORTION_FRACTION = 0.5
"""Fraction of the change of the focal length when the lens may bend that counts as deviation where
it is taken for a pinhole."""
FIELDS_OF_VIEW = 15.0, 150.0
"""Degrees along the longer side; what lies outside is no pinhole camera's."""
AGREEMENT = 3.0
"""Deviations by which two stretches may differ and still agree."""


@dataclass(frozen=True)
class Estimate:
    """What one stretch says, or several together."""

    lens: RadialLens
    covariance: Float64[Tensor, "3 3"]
    """Of the logarithm of the focal length, k1 and k2; zero for those that are known."""
    keyframes: int

    @property
    def camera(self) -> Camera:
        """The lens' pinhole."""
        return self.lens.camera

    @property
    def sizes(self) -> Float64[Tensor, "3"]:
        """Logarithm of the focal length, k1 and k2."""
        lens = self.lens
        return torch.tensor([math.log(lens.camera.fx), lens.k1, lens.k2], dtype=torch.float64)

    @property
    def deviations(self) -> tuple[float, float, float]:
        """Of each of the sizes."""
        focal, k1, k2 = self.covariance.diagonal().sqrt().tolist()
        return focal, k1, k2

    @property
    def deviation(self) -> float:
        """Standard deviation of the focal length, relative."""
        return self.deviations[0]

    def as_told(self) -> "Estimate":
        """A pinhole where the matches do not tell that the lens bends: real ones that tell little
        of it err alike, too, and the focal length by as much as k1 and k2 lean on it."""
        bend, lean = self.covariance[1:, 1:], self.covariance[1:, 0]
        k = self.sizes[1:]
        if not bool((bend.diagonal() > 0).all()) or k @ torch.linalg.solve(bend, k) >= EVIDENCE:
            return self
        follows = torch.linalg.solve(bend, lean)
        shift = -float(follows @ k)
        left = float(self.covariance[0, 0] - follows @ lean) + (DISTORTION_FRACTION * shift) ** 2
        covariance = torch.zeros_like(self.covariance)
        covariance[0, 0] = max(left, LEAST_DEVIATION**2)
        pinhole = RadialLens(self.lens.camera).moved(shift)
        return Estimate(pinhole, covariance, self.keyframes)

    def moved(
        self, sizes: Float64[Tensor, "3"], covariance: Float64[Tensor, "3 3"], keyframes: int
    ) -> "Estimate":
        """Another, of a lens of these sizes."""
        return Estimate(self.lens.moved(*(sizes - self.sizes).tolist()), covariance, keyframes)


def relative_error(bundle: GrowingBundle) -> float:
    """Deviation of the focal length by the matches alone, relative."""
    assert bundle.result is not None
    error = STANDARD_ERRORS * math.sqrt(float(bundle.result.covariance[0, 0]))
    return math.hypot(error, LEAST_DEVIATION)


def estimate(bundle: GrowingBundle, radial: bool) -> Estimate | str:
    """What an adjusted stretch says, with k1 and k2 if ``radial``, or why it is not believed."""
    result = bundle.result
    assert result is not None
    lens = result.block.lens
    angle = 2 * math.degrees(math.atan(lens.camera.long_edge / 2 / lens.camera.fx))
    if not FIELDS_OF_VIEW[0] < angle < FIELDS_OF_VIEW[1]:
        return f"it seems to have a field of view of {angle:.0f} degrees"
    if result.cost > MAX_COST:
        return Degeneracy.UNEXPLAINED.value
    least = LEAST_DEVIATION**2 * torch.eye(3, dtype=torch.float64)
    covariance = STANDARD_ERRORS**2 * result.covariance + least
    if not radial:
        covariance[1:] = covariance[:, 1:] = 0
    return Estimate(lens, covariance, len(bundle))


def joined(estimates: Sequence[Estimate]) -> Estimate:
    """What several stretches say together, and what is known of lenses (``PRIOR``): the mean, by
    their covariances, of the logarithm of the focal length, k1 and k2.

    Those that agree with each other decide. Where they are no majority all count, and what they
    differ by makes the deviation as large as it has to be.
    """
    party = max(
        ([b for b in estimates if _agree(a, b)] for a in estimates),
        key=lambda p: (len(p), sum(e.deviation**-2 for e in p)),
    )
    if 2 * len(party) <= len(estimates):
        party = list(estimates)
    first = party[0]
    free = first.covariance.diagonal() > 0
    known = torch.tensor([0.0, *(sigma**-2 for sigma in PRIOR)], dtype=torch.float64).diag()
    each = [torch.linalg.inv(e.covariance[free][:, free]) for e in party]
    whole = torch.linalg.inv(sum(each, known[free][:, free]))
    mean = first.sizes
    mean[free] = whole @ sum(
        (P @ e.sizes[free] for P, e in zip(each, party, strict=True)), 0 * mean[free]
    )
    squares = sum(float((e.sizes - mean)[0] / e.deviation) ** 2 for e in party)
    excess = max(1.0, squares / (len(party) - 1)) if len(party) > 1 else 1.0
    covariance = torch.zeros(3, 3, dtype=torch.float64)
    covariance[free[:, None] & free] = (excess * whole).flatten()
    covariance[0, 0] = covariance[0, 0].clamp(min=LEAST_DEVIATION**2)
    return first.moved(mean, covariance, sum(e.keyframes for e in party))


def _agree(a: Estimate, b: Estimate) -> bool:
    off = abs(math.log(a.camera.fx / b.camera.fx))
    return off <= AGREEMENT * math.hypot(a.deviation, b.deviation)
