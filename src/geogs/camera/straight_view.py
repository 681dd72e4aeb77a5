"""Pixels that a found lens shows, and those of the pinhole that it was taken for."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from geogs.camera.distortion import RESAMPLING, distorted_pixels, lens_maps
from geogs.geometry.camera import Camera
from geogs.types import FoundLens, FrameLens

FARTHEST, ENTRIES = 4.0, 1 << 14
"""End of the table by which rays are straightened, in diagonals of the image, and its entries;
linear between them, which is exact to 1e-5 pixels."""
RADII = 64
"""Rays by which two lenses in turn become one."""


@dataclass(frozen=True)
class StraightView:
    """A pinhole, and the lens that saw in its place."""

    camera: Camera
    """The pinhole."""
    lens: FoundLens

    @staticmethod
    def of_pinhole(camera: Camera) -> "StraightView":
        """The view of images that are straight already."""
        return StraightView(camera, FoundLens(0.0, 0.0, 0.0, 0.0))

    @property
    def seen_by(self) -> Camera:
        """The lens without its distortion."""
        camera, lens = self.camera, self.lens
        fx, fy = lens.focal * camera.fx, lens.focal * camera.fy
        cx, cy = camera.cx + lens.right * fx, camera.cy + lens.down * fy
        return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy)

    @property
    def distortion(self) -> tuple[float, float, float, float]:
        """OpenCV's k1, k2, p1, p2."""
        return self.lens.k1, self.lens.k2, 0.0, 0.0

    def followed_by(self, other: FoundLens) -> FoundLens:
        """The lens of images that still bend by the other one when they are straightened by this.

        k1 and k2 by least squares over the image. Deviations are those of the other, which was
        found last, and of both focal lengths. Principal points add up, to first order.
        """
        camera, lens = self.camera, self.lens
        x = max(camera.cx, camera.width - 1 - camera.cx) / camera.fx
        y = max(camera.cy, camera.height - 1 - camera.cy) / camera.fy
        r = np.linspace(0.0, np.hypot(x, y), RADII)
        bent = other.focal * r * (1 + other.k1 * r**2 + other.k2 * r**4)
        seen = lens.focal * bent * (1 + lens.k1 * bent**2 + lens.k2 * bent**4)
        focal = lens.focal * other.focal
        (k1, k2), *_ = np.linalg.lstsq(np.stack([r**3, r**5], 1), seen / focal - r, rcond=None)
        deviation = float(np.hypot(lens.deviation_focal, other.deviation_focal))
        own = other.deviation_k1, other.deviation_k2
        right, down = lens.right / other.focal + other.right, lens.down / other.focal + other.down
        return FoundLens(
            float(k1), float(k2), *own, focal, deviation, right, down, other.deviation_centre
        )

    def of_frame(self, own: FrameLens) -> "StraightView":
        """The view of a frame whose lens has something of its own."""
        return replace(self, lens=self.lens.of_frame(own))

    # --- points ----------------------------------------------------------------------------

    def bent(self, pixels: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Where the lens shows what the pinhole shows at some pixels."""
        camera = self.camera
        flat = pixels.reshape(-1, 2).double().cpu().numpy()
        rays = (flat - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        seen = distorted_pixels(rays, self.seen_by, self.distortion)
        return torch.from_numpy(seen).to(pixels).reshape(pixels.shape)

    def straight(self, pixels: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Where the pinhole shows what the lens shows at some pixels; NaN where it shows nothing,
        as beyond where a polynomial turns back."""
        camera, seen_by = self.camera, self.seen_by
        flat = pixels.reshape(-1, 2).double().cpu().numpy()
        plane = (flat - (seen_by.cx, seen_by.cy)) / (seen_by.fx, seen_by.fy)
        bent, straight = self._radii
        radius = np.hypot(plane[:, 0], plane[:, 1])
        factor = np.interp(radius, bent, straight / np.maximum(bent, 1e-12), right=np.nan)
        rays = plane * factor[:, None]
        shown = rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        return torch.from_numpy(shown).to(pixels).reshape(pixels.shape)

    @cached_property
    def _radii(self) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Distances from the axis, of focal length 1, that the lens shows, and the pinhole there;
        up to where the lens turns back."""
        camera, (k1, k2) = self.seen_by, self.distortion[:2]
        corner = np.hypot(camera.width / camera.fx, camera.height / camera.fy)
        straight = np.linspace(0.0, FARTHEST * corner, ENTRIES)[1:]
        bent = straight * (1 + k1 * straight**2 + k2 * straight**4)
        back = np.flatnonzero(np.diff(bent, prepend=0.0) <= 0)
        end = back[0] if len(back) else len(bent)
        return bent[:end], straight[:end]

    # --- images ----------------------------------------------------------------------------

    def image(self, bent: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """The image that the pinhole sees. What is beyond the border gets its colour; what was
        masked out stays black."""
        straight = cv2.remap(bent, *self._maps, RESAMPLING, borderMode=cv2.BORDER_REPLICATE)
        black = bent[..., 0] | bent[..., 1] | bent[..., 2]  # one after the other: quicker
        straight[self.nearest(black) == 0] = 0
        return straight

    def nearest(self, bent: Shaped[np.ndarray, "h w *c"]) -> Shaped[np.ndarray, "h w *c"]:
        """Values of the pixels that the lens saw, the nearest ones beyond its border."""
        row, column = self._nearest
        return bent[row, column]

    @cached_property
    def is_seen(self) -> Bool[np.ndarray, "h w"]:
        """Which pixels of the pinhole the lens saw."""
        u, v = self._maps
        width, height = self.camera.width, self.camera.height
        return (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)

    @cached_property
    def _maps(self) -> tuple[np.ndarray, np.ndarray]:
        return lens_maps(self.camera, self.seen_by, self.distortion, "polynomial")

    @cached_property
    def _nearest(self) -> tuple[Int[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
        u, v = (np.rint(m).astype(int) for m in self._maps)
        return v.clip(0, self.camera.height - 1), u.clip(0, self.camera.width - 1)


@dataclass(frozen=True)
class FrameViews:
    """How frames of a video are straightened, whose lenses may have something of their own."""

    view: StraightView
    """By the lens of all."""
    own: Mapping[int, FrameLens] = field(default_factory=dict)
    """By the indices of the frames."""

    def of(self, frame: int) -> StraightView:
        """That of a frame."""
        own = self.own.get(frame)
        return self.view if own is None else self.view.of_frame(own)

    def alike(self, frame: int, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """The image of a frame as the lens of all saw it: what its own has beside that taken off.

        What is beyond the border gets its colour.
        """
        if frame not in self.own:
            return image
        common, own = self.view.seen_by, self.of(frame).seen_by
        factor = common.fx / own.fx
        right, down = common.cx - factor * own.cx, common.cy - factor * own.cy
        to, size = np.array([[factor, 0, right], [0, factor, down]]), (common.width, common.height)
        return cv2.warpAffine(image, to, size, flags=RESAMPLING, borderMode=cv2.BORDER_REPLICATE)
