"""Which pixels may show the scene."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from geogs.tracking.flow.masked import valid_pixels
from geogs.world.keyframes import Keyframe


@dataclass(frozen=True, eq=False)
class SceneMask:
    """A mask of all images, and whether black pixels of each are masked out."""

    fixed: Bool[np.ndarray, "h w"] | None = None
    """True where images may show the scene; None takes all."""
    black_is_masked: bool = False

    def of(self, keyframe: Keyframe) -> Bool[np.ndarray, "h w"] | None:
        """What a keyframe shows of the scene; None where that is all of its image."""
        if not self.black_is_masked:
            return self.fixed
        valid = valid_pixels(keyframe.image)
        if self.fixed is not None:
            valid &= self.fixed
        return None if valid.all() else valid
