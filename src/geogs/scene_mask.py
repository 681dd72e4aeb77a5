"""Mask of the pixels that may show the scene."""

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from geogs.camera.straight_view import StraightView
from geogs.geometry.camera import Camera
from geogs.tracking.flow.masked import valid_pixels
from geogs.types import FoundLens
from geogs.world.keyframes import Keyframe


@functools.lru_cache(maxsize=1)
def _view(camera: Camera, lens: FoundLens) -> StraightView:
    """One view for all keyframes, which keeps what it has computed."""
    return StraightView(camera, lens)


@dataclass(frozen=True, eq=False)
class SceneMask:
    """A mask of all images, and whether black pixels of each are masked out."""

    fixed: Bool[np.ndarray, "h w"] | None = None
    """True where images may show the scene; None takes all."""
    black_is_masked: bool = False

    def of(self, keyframe: Keyframe) -> Bool[np.ndarray, "h w"] | None:
        """Valid pixels of a keyframe; None where all are.

        Pixels of a straightened image that the lens did not see are not valid.
        """
        table = keyframe.table
        fixed = self.fixed
        if table.lens is not None:
            view = _view(table.camera, table.lens)
            own = table.frame_lenses.get(keyframe.id)
            fixed = self._straight(view if own is None else view.of_frame(own))
        if not self.black_is_masked:
            return fixed
        valid = valid_pixels(keyframe.image)
        if fixed is not None:
            valid &= fixed
        return None if valid.all() else valid

    def _straight(self, view: StraightView) -> Bool[np.ndarray, "h w"] | None:
        """Valid pixels of straightened images; None where all are."""
        valid = view.is_seen if self.fixed is None else view.is_seen & view.nearest(self.fixed)
        return None if valid.all() else valid
