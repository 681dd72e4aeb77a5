"""What matches say of the lens: that of all frames, and what frames have of their own."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch

from geogs.bundle.uncertainty.varying_intrinsics import OWN, VaryingPrior
from geogs.camera.straight_view import FrameViews, StraightView
from geogs.geometry.camera import Camera
from geogs.tracking.frame_lenses import shift_frames
from geogs.types import FoundLens, FrameLens
from geogs.world.frames import FrameLog
from geogs.world.keyframes import KeyframeSet


@dataclass(frozen=True)
class FoundLenses:
    """A lens that was found; true where one was."""

    lens: FoundLens | None = None
    """Of all frames."""
    own: Mapping[int, FrameLens] = field(default_factory=dict)
    """By the indices of the frames that have a place."""
    prior: VaryingPrior | None = None
    """By which they vary, where they do."""

    def __bool__(self) -> bool:
        return self.lens is not None

    def followed_by(self, camera: Camera, other: "FoundLenses") -> "FoundLenses":
        """With what was found on images that are straight by this."""
        if self.lens is None or other.lens is None:
            return other if self.lens is None else self
        lens = StraightView(camera, self.lens).followed_by(other.lens)
        none = FrameLens()
        own = {
            n: self.own.get(n, none).plus(other.own.get(n, none))
            for n in sorted(self.own.keys() | other.own.keys())
        }
        return FoundLenses(lens, own, other.prior or self.prior)

    def shift(self, log: FrameLog, keyframes: KeyframeSet) -> None:
        """Correct what was found of frames, beside what it was corrected by. After the lens of all
        (``shift_lens``), which takes the place of what was there."""
        if self.lens is None:
            return
        lens, each = self.lens, list(OWN)
        common = torch.tensor([math.log(lens.focal), lens.k1, lens.k2, lens.right, lens.down])
        sizes = {
            n: common.double().index_add(0, torch.tensor(each), torch.tensor(o.sizes).double())
            for n, o in self.own.items()
        }
        shift_frames(log, keyframes, sizes)

    def views(self, camera: Camera) -> FrameViews:
        """How frames of a lens that was found are straightened."""
        assert self.lens is not None
        each = torch.tensor([o.sizes for o in self.own.values()] or [FrameLens().sizes])
        focal, right, down = each.double().square().mean(0).sqrt().tolist()
        lens = replace(self.lens, varies_focal=focal, varies_centre=math.hypot(right, down))
        return FrameViews(StraightView(camera, lens), self.own)
