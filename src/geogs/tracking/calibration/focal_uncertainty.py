"""Focal length and distortion by one stretch of a video, with their deviations."""

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
"""Relative: no focal length is known better, however many matches agree; nor are k1 and k2."""
MOST_BEND = 4.0
"""Usual deviations of k1 and k2 beyond which matches tell of no lens, but of nothing at all."""
UNRELIABLE = 0.1
"""Relative deviation above which the focal length is not believed and the guess is kept, which may
be as good."""
FIELDS_OF_VIEW = 15.0, 150.0
"""Degrees along the longer side; what lies outside is no pinhole camera's."""


@dataclass(frozen=True)
class Estimate:
    """The lens by one stretch."""

    lens: Camera
    covariance: Float64[Tensor, "3 3"]
    """Covariance of log focal length, k1 and k2; zero for those that are known."""
    keyframes: int
    readout: FoundReadout | None = None
    """None where it was not asked for, or images are too far apart to show it."""

    @property
    def deviations(self) -> tuple[float, float, float]:
        """Standard deviation of each of these."""
        focal, k1, k2 = self.covariance.diagonal().sqrt().tolist()
        return focal, k1, k2

    @property
    def deviation(self) -> float:
        """Standard deviation of the focal length, relative."""
        return self.deviations[0]


def estimate(bundle: GrowingBundle, unknowns: Unknowns) -> Estimate | str:
    """Estimate by an adjusted stretch, or why it is not believed."""
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
    if result.block.rows is not None and result.block.rolls:
        readout = FoundReadout(result.block.readout, UNIT * float(whole[3, 3].sqrt()))
    said = with_prior(Estimate(lens, covariance, len(bundle), readout))
    if said.deviation < UNRELIABLE:
        return said
    return f"its motion leaves the focal length unsure by {100 * said.deviation:.0f} %"


def with_prior(said: Estimate) -> Estimate:
    """The estimate joined with what is known of any lens: k1 and k2 are about zero, which a narrow
    field of view does not tell."""
    lens = said.lens
    size = torch.tensor([0.0, lens.k1, lens.k2], dtype=torch.float64)
    told = LensEstimate(size, said.covariance)
    for n, deviation in enumerate(USUAL_BEND, 1):
        told = told.told(n, 0.0, deviation)
    moved = lens.moved(*(told.size - size).tolist())
    return Estimate(moved, told.covariance, said.keyframes, said.readout)
