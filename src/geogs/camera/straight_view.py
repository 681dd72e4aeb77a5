"""Mapping between the pixels of images as they came and those of the pinhole of a map."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, Shaped, UInt8
from torch import Tensor

from geogs.camera.depth_images import sampled
from geogs.camera.distortion import RESAMPLING, lens_maps
from geogs.geometry.camera import Camera
from geogs.types import FoundLens, FrameLens


@dataclass(frozen=True)
class StraightView:
    """A pinhole, and the camera that took the images."""

    camera: Camera
    """The pinhole of the straight images."""
    assumed: Camera
    """The camera of the images, as it was assumed."""
    lens: FoundLens = field(default_factory=FoundLens)
    """What was found of its lens since."""

    @cached_property
    def seen_by(self) -> Camera:
        """The camera of the images."""
        lens = self.lens
        return self.assumed.moved(math.log(lens.focal), lens.k1, lens.k2, lens.right, lens.down)

    def of_frame(self, own: FrameLens) -> "StraightView":
        """Return the view of a frame with intrinsics of its own."""
        return replace(self, lens=self.lens.of_frame(own))

    # --- points ----------------------------------------------------------------------------

    def bent(self, pixels: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Map pixels of the pinhole to pixels of the lens."""
        return self.seen_by.pixels(self.camera.plane(pixels.double())).to(pixels)

    def straight(self, pixels: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Map pixels of the lens to pixels of the pinhole; NaN where the lens shows nothing, as
        beyond the maximum of a polynomial's radius."""
        plane = self.seen_by.plane(pixels.double())
        error = (self.seen_by.pixels(plane) - pixels).norm(dim=-1, keepdim=True)
        return torch.where(error < 1e-3, self.camera.pixels(plane), torch.nan).to(pixels)

    # --- images ----------------------------------------------------------------------------

    def image(self, bent: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Straighten an image. Pixels beyond the border get its colour; masked-out pixels stay
        black."""
        straight = cv2.remap(bent, *self._maps, RESAMPLING, borderMode=cv2.BORDER_REPLICATE)
        black = bent[..., 0] | bent[..., 1] | bent[..., 2]  # faster than a reduction
        straight[self.nearest(black) == 0] = 0
        return straight

    def nearest(self, bent: Shaped[np.ndarray, "h w *c"]) -> Shaped[np.ndarray, "h w *c"]:
        """Straighten by nearest neighbours; beyond the border the nearest pixels count."""
        row, column = self._nearest
        return bent[row, column]

    def depth(self, bent: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
        """Straighten sensor depth; 0 where unknown."""
        return sampled(bent, *self._maps)

    @cached_property
    def is_seen(self) -> Bool[np.ndarray, "h w"]:
        """Whether the lens saw each pixel of the pinhole."""
        u, v = self._maps
        width, height = self.camera.width, self.camera.height
        return (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)

    @cached_property
    def _maps(self) -> tuple[np.ndarray, np.ndarray]:
        return lens_maps(self.camera, self.seen_by)

    @cached_property
    def _nearest(self) -> tuple[Int[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
        u, v = (np.rint(m).astype(int) for m in self._maps)
        return v.clip(0, self.camera.height - 1), u.clip(0, self.camera.width - 1)


@dataclass(frozen=True)
class FrameViews:
    """Views of the frames of a video, or of its keyframes, whose intrinsics may vary."""

    view: StraightView
    """View of the shared lens."""
    own: Mapping[int, FrameLens] = field(default_factory=dict)
    """Per-frame intrinsics by the indices of the frames, or the ids of the keyframes."""

    def of(self, frame: int) -> StraightView:
        """Return the view of a frame."""
        own = self.own.get(frame)
        return self.view if own is None else self.view.of_frame(own)

    def alike(self, frame: int, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Warp the image of a frame to the shared lens, to remove its per-frame intrinsics.

        Pixels beyond the border get its colour.
        """
        if frame not in self.own:
            return image
        common = self.view.seen_by
        own = self.of(frame).seen_by
        factor = common.fx / own.fx
        right, down = common.cx - factor * own.cx, common.cy - factor * own.cy
        to = np.array([[factor, 0, right], [0, factor, down]])
        size = (common.width, common.height)
        return cv2.warpAffine(image, to, size, flags=RESAMPLING, borderMode=cv2.BORDER_REPLICATE)
