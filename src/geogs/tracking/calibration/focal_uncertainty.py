"""Focal length and distortion estimated from one stretch of a video, with standard deviations."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from geogs.bundle.lens import UNIT
from geogs.bundle.uncertainty.lens_error import STANDARD_ERRORS, LensEstimate
from geogs.camera.distortion import USUAL_BEND
from geogs.camera.shutter.readout import FoundReadout
from geogs.geometry.camera import Camera
from geogs.tracking.calibration.degeneracy import MAX_RESIDUAL, Degeneracy
from geogs.tracking.calibration.growing_bundle import GrowingBundle
from geogs.tracking.calibration.unknowns import Unknowns

LEAST_DEVIATION = 0.002
"""Least deviation of the focal length, relative, and of k1 and k2, however many matches agree."""
MOST_BEND = 4.0
"""Prior deviations of k1 and k2 beyond which an estimate is rejected as no real lens."""
UNRELIABLE = 0.1
"""Relative deviation above which the focal length is rejected and the guess, which may be as good,
is kept."""
FIELDS_OF_VIEW = 15.0, 150.0
"""Accepted range of a pinhole camera's field of view, degrees along the longer side."""


@dataclass(frozen=True)
class Estimate:
    """Lens estimated from one stretch."""

    lens: Camera
    covariance: Float64[Tensor, "3 3"]
    """Covariance of log focal length, k1 and k2; zero for those that are known."""
    keyframes: int
    readout: FoundReadout | None = None
    """None where it was not estimated, or images are too far apart to show it."""

    @property
    def deviations(self) -> tuple[float, float, float]:
        """Standard deviation of each of the three."""
        focal, k1, k2 = self.covariance.diagonal().sqrt().tolist()
        return focal, k1, k2

    @property
    def deviation(self) -> float:
        """Standard deviation of the focal length, relative."""
        return self.deviations[0]


def estimate(bundle: GrowingBundle, unknowns: Unknowns) -> Estimate | str:
    """Return the estimate from an adjusted stretch, or why it is rejected."""
    result = bundle.result
    assert result is not None
    lens = result.block.lens
    angle = 2 * math.degrees(math.atan(lens.long_edge / 2 / lens.fx))
    if not FIELDS_OF_VIEW[0] < angle < FIELDS_OF_VIEW[1]:
        return f"it seems to have a field of view of {angle:.0f} degrees"
    bends = zip((lens.k1, lens.k2), USUAL_BEND, strict=True)
    if any(abs(k) > MOST_BEND * usual for k, usual in bends):
        return "its lens seems to bend as none does"
    if unknowns.focal and bundle.residual > MAX_RESIDUAL:
        return Degeneracy.UNEXPLAINED.value
    asked = torch.tensor([unknowns.focal, unknowns.radial, unknowns.radial]).double()
    whole = STANDARD_ERRORS**2 * result.covariance
    covariance = whole[:3, :3] + LEAST_DEVIATION**2 * asked.diag()
    readout = None
    if result.block.rolls:
        readout = FoundReadout(result.block.readout, UNIT * float(whole[3, 3].sqrt()))
    said = with_prior(Estimate(lens, covariance, len(bundle), readout))
    if said.deviation < UNRELIABLE:
        return said
    return f"its motion leaves the focal length unsure by {100 * said.deviation:.0f} %"


def with_prior(said: Estimate) -> Estimate:
    """Combine an estimate with the prior that k1 and k2 are about zero, as a narrow field of view
    does not determine them."""
    lens = said.lens
    size = torch.tensor([0.0, lens.k1, lens.k2], dtype=torch.float64)
    told = LensEstimate(size, said.covariance)
    for n, deviation in enumerate(USUAL_BEND, 1):
        told = told.told(n, 0.0, deviation)
    moved = lens.moved(*(told.size - size).tolist())
    return Estimate(moved, told.covariance, said.keyframes, said.readout)
