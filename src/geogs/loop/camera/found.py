"""What matches say of the lens: that of all frames, and what frames have of their own."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch

from geogs.bundle.uncertainty.varying_intrinsics import VaryingPrior
from geogs.camera.straight_view import FrameViews, StraightView
from geogs.geometry.camera import Camera
from geogs.types import FoundLens, FrameLens


@dataclass(frozen=True)
class FrameLenses:
    """What frames have of their own; true where they have something."""

    each: Mapping[int, FrameLens] = field(default_factory=dict)
    """By the indices of the frames that have a place."""
    prior: VaryingPrior | None = None
    """By which they vary, where they do."""

    def __bool__(self) -> bool:
        return self.prior is not None


def found_lens(given: Camera, found: Camera, said: FoundLens | None = None) -> FoundLens:
    """The lens of a camera that was found, of images that were taken for those of a pinhole; what
    was ``said`` of its deviations before stays."""
    focal, k1, k2, right, down = found.moves_from(given)
    said = said or FoundLens(0.0, 0.0, 0.0, 0.0)
    return replace(said, k1=k1, k2=k2, focal=math.exp(focal), right=right, down=down)


def straight_views(
    given: Camera, found: Camera, said: FoundLens | None, own: FrameLenses
) -> FrameViews:
    """How frames of a camera that was found are straightened."""
    each = torch.tensor([o.sizes for o in own.each.values()] or [FrameLens().sizes])
    focal, right, down = each.double().square().mean(0).sqrt().tolist()
    lens = found_lens(given, found, said)
    lens = replace(lens, varies_focal=focal, varies_centre=math.hypot(right, down))
    return FrameViews(StraightView(given, lens), own.each)
