"""Lens estimated from matches: shared lens and per-frame intrinsics."""

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
    """Per-frame intrinsics; true if they vary."""

    each: Mapping[int, FrameLens] = field(default_factory=dict)
    """Intrinsics by the indices of the located frames."""
    prior: VaryingPrior | None = None
    """Prior of the variation; None if they do not vary."""

    def __bool__(self) -> bool:
        return self.prior is not None


def found_lens(given: Camera, found: Camera, said: FoundLens | None = None) -> FoundLens:
    """Return the lens of an estimated camera relative to the ``given`` pinhole; deviations are
    those in ``said``."""
    focal, k1, k2, right, down = found.moves_from(given)
    said = said or FoundLens(0.0, 0.0, 0.0, 0.0)
    return replace(said, k1=k1, k2=k2, focal=math.exp(focal), right=right, down=down)


def straight_views(
    given: Camera, found: Camera, said: FoundLens | None, own: FrameLenses
) -> FrameViews:
    """Return the views that straighten the frames of an estimated camera."""
    each = torch.tensor([o.sizes for o in own.each.values()] or [FrameLens().sizes])
    focal, right, down = each.double().square().mean(0).sqrt().tolist()
    lens = found_lens(given, found, said)
    lens = replace(lens, varies_focal=focal, varies_centre=math.hypot(right, down))
    return FrameViews(StraightView(given, lens), own.each)
