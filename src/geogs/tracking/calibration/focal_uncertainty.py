"""Uncertainty of the focal length by one stretch of a video, and by several together."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from geogs.geometry.camera import Camera
from geogs.tracking.calibration.degeneracy import MAX_COST, Degeneracy
from geogs.tracking.calibration.growing_bundle import GrowingBundle

STANDARD_ERRORS = 3.0
"""The adjustment's own standard error times this is taken for the deviation: matches of different
keyframes err alike too. Measured on rendered rooms, where errors are 1 to 7 standard errors."""
LEAST_DEVIATION = 0.002
"""Relative: no focal length is known better, however many matches agree."""
DISTORTION_FRACTION = 0.5
"""Fraction of the change of the focal length when k1 is free too that counts as deviation."""
FIELDS_OF_VIEW = 15.0, 150.0
"""Degrees along the longer side; what lies outside is no pinhole camera's."""
AGREEMENT = 3.0
"""Deviations by which two stretches may differ and still agree."""


@dataclass(frozen=True)
class Estimate:
    """What one stretch says, or several together."""

    camera: Camera
    k1: float
    deviation: float
    """Standard deviation of the focal length, relative."""
    deviation_k1: float
    keyframes: int

    @property
    def log_focal(self) -> float:
        """Its deviation is the relative one of the focal length."""
        return math.log(self.camera.fx)


def relative_error(bundle: GrowingBundle) -> float:
    """Deviation of the focal length by the matches alone, relative."""
    assert bundle.result is not None
    error = STANDARD_ERRORS * math.sqrt(float(bundle.result.covariance[0, 0]))
    return math.hypot(error, LEAST_DEVIATION)


def estimate(bundle: GrowingBundle, radial: bool) -> Estimate | str:
    """What an adjusted stretch says, or why it is not believed."""
    result = bundle.result
    assert result is not None
    deviation = relative_error(bundle)
    if not radial:
        other = bundle.solve(radial=True)
        shift = math.log(other.block.lens.camera.fx / result.block.lens.camera.fx)
        deviation = math.hypot(deviation, DISTORTION_FRACTION * shift)
    lens = result.block.lens
    angle = 2 * math.degrees(math.atan(lens.camera.long_edge / 2 / lens.camera.fx))
    if not FIELDS_OF_VIEW[0] < angle < FIELDS_OF_VIEW[1]:
        return f"it seems to have a field of view of {angle:.0f} degrees"
    if result.cost > MAX_COST:
        return Degeneracy.UNEXPLAINED.value
    error_k1 = STANDARD_ERRORS * math.sqrt(float(result.covariance[1, 1]))
    return Estimate(lens.camera, lens.k1, deviation, error_k1, len(bundle))


def joined(estimates: Sequence[Estimate]) -> Estimate:
    """What several stretches say together: the mean of the logarithms, by their variances.

    Those that agree with each other decide. Where they are no majority all count, and what they
    differ by makes the deviation as large as it has to be.
    """
    party = max(
        ([b for b in estimates if _agree(a, b)] for a in estimates),
        key=lambda p: (len(p), sum(e.deviation**-2 for e in p)),
    )
    if 2 * len(party) <= len(estimates):
        party = list(estimates)
    weights = [e.deviation**-2 for e in party]
    total = sum(weights)
    mean = sum(w * e.log_focal for w, e in zip(weights, party, strict=True)) / total
    squares = sum(w * (e.log_focal - mean) ** 2 for w, e in zip(weights, party, strict=True))
    excess = max(1.0, squares / max(len(party) - 1, 1))
    best = min(party, key=lambda e: e.deviation)
    return Estimate(
        best.camera.with_focal(math.exp(mean)),
        best.k1,
        max(math.sqrt(excess / total), LEAST_DEVIATION),
        best.deviation_k1,
        sum(e.keyframes for e in party),
    )


def _agree(a: Estimate, b: Estimate) -> bool:
    return abs(a.log_focal - b.log_focal) <= AGREEMENT * math.hypot(a.deviation, b.deviation)
