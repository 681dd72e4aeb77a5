"""Mask of the pixels that may show the scene."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from geogs.camera.straight_view import StraightView
from geogs.tracking.flow.masked import valid_pixels
from geogs.world.keyframes import Keyframe


@dataclass(frozen=True, eq=False)
class SceneMask:
    """A mask for all images, and whether black pixels are masked out, too."""

    fixed: Bool[np.ndarray, "h w"] | None = None
    """True where images may show the scene; None for all pixels."""
    black_is_masked: bool = False

    def of(self, keyframe: Keyframe) -> Bool[np.ndarray, "h w"] | None:
        """Return the valid pixels of a keyframe; None where all are.

        Pixels of a straightened image that the lens did not see are not valid.
        """
        view = keyframe.table.view_of(keyframe.id)
        fixed = self.fixed
        if view is not None:
            fixed = self._straight(view)
        if not self.black_is_masked:
            return fixed
        valid = valid_pixels(keyframe.straight_image)
        if fixed is not None:
            valid &= fixed
        return None if valid.all() else valid

    def _straight(self, view: StraightView) -> Bool[np.ndarray, "h w"] | None:
        """Return the valid pixels of straightened images; None where all are."""
        valid = view.is_seen if self.fixed is None else view.is_seen & view.nearest(self.fixed)
        return None if valid.all() else valid
