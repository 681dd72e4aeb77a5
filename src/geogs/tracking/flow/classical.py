"""Flow without a network: dense inverse search on what the present reprojection leaves over.

The second image is warped into the first by the reprojection and brought to its local brightness,
OpenCV's DIS flow is computed on the pair and the warp is added back, so wide baselines are matched
as well as narrow ones. Both directions are computed; their disagreement and the roughness of the
flow that was left over give the variance of a match.
"""

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.tracking.flow.base import FlowMatch
from geogs.tracking.grid import OFFSET, STRIDE, SampleGrid

FAR = 1e3
"""Stands for a position outside the image, in pixels."""
MAX_DISAGREEMENT = 1.0
"""Forward and backward flow that differ by more pixels are no match."""
COARSE_DEVIATION = 1.7
"""Deviation of a match at half resolution relative to full resolution."""
SMALL_IMAGE = 400
"""Long edge in pixels up to which every measurement is at full resolution."""
MIN_STRUCTURE = 0.5
"""Smaller eigenvalue of the structure tensor that counts as texture, grey levels^2 / pixel^2."""


@dataclass(frozen=True)
class ClassicalImage:
    """An image as the classical operator keeps it."""

    grey: UInt8[np.ndarray, "h w"]
    structure: Float[np.ndarray, "p"]
    """Smaller eigenvalue of the structure tensor on the grid, grey levels^2 / pixel^2."""


@dataclass(frozen=True)
class _DenseFlow:
    """Flow on every pixel, and what is needed to judge it."""

    flow: np.ndarray
    roughness: np.ndarray
    """Mean gradient of the flow without the warp, around each grid cell."""


class ClassicalFlow:
    """The DIS operator on one grid; images are matched in a small thread pool."""

    def __init__(self, grid: SampleGrid, threads: int = 2) -> None:
        cv2.setNumThreads(1)
        self.grid = grid
        self._pool = ThreadPoolExecutor(threads)
        self._local = threading.local()
        width, height = grid.camera.width, grid.camera.height
        v, u = np.mgrid[:height, :width].astype(np.float32)
        self._u, self._v = u, v
        self._up_u, self._up_v = (u - OFFSET) / STRIDE, (v - OFFSET) / STRIDE
        self._pixels = grid.pixels.cpu().numpy()

    def encode(self, image: UInt8[np.ndarray, "h w 3"]) -> ClassicalImage:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        return ClassicalImage(grey, self._on_grid(_smaller_eigenvalue(grey)))

    def texture(self, encoded: ClassicalImage) -> float:
        return float((encoded.structure > MIN_STRUCTURE).mean())

    def measure(
        self,
        first: Sequence[ClassicalImage],
        second: Sequence[ClassicalImage],
        forward: Float[Tensor, "e p 2"] | None = None,
        backward: Float[Tensor, "e p 2"] | None = None,
        fine: bool = True,
    ) -> tuple[FlowMatch, FlowMatch]:
        # Half of a small image is too little to match.
        fine = fine or max(self.grid.camera.width, self.grid.camera.height) <= SMALL_IMAGE
        a = [*first, *second]
        b = [*second, *first]
        n = len(first)
        start = [None] * (2 * n)
        if forward is not None and backward is not None:
            start = list(torch.cat([forward, backward]).cpu().numpy())
        flows = list(self._pool.map(lambda x, y, s: self._dense(x, y, s, fine), a, b, start))
        reverse = [*flows[n:], *flows[:n]]
        scale = 1.0 if fine else COARSE_DEVIATION
        matches = list(
            self._pool.map(lambda x, f, r: self._match(x, f, r, scale), a, flows, reverse)
        )
        pixels = torch.from_numpy(np.stack([m[0] for m in matches])).to(self.grid.device)
        weight = torch.from_numpy(np.stack([m[1] for m in matches])).to(self.grid.device)
        return FlowMatch(pixels[:n], weight[:n]), FlowMatch(pixels[n:], weight[n:])

    def _dis(self, scale: int, cold: bool = False) -> cv2.DISOpticalFlow:
        """This thread's flow object whose finest level is ``scale`` halvings down."""
        name = f"dis{scale}{'cold' if cold else ''}"
        found = getattr(self._local, name, None)
        if found is None:
            found = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
            found.setFinestScale(scale)
            if not cold:
                # Measured: as precise as the preset on warped pairs, at half its time.
                found.setGradientDescentIterations(6)
                found.setPatchStride(5)
            # Smoother, and gradients rather than brightness: less noise, less light.
            found.setVariationalRefinementAlpha(40.0)
            found.setVariationalRefinementDelta(1.0)
            setattr(self._local, name, found)
        return found

    def _dense(
        self, a: ClassicalImage, b: ClassicalImage, start: np.ndarray | None, fine: bool
    ) -> _DenseFlow:
        """Flow from a to b."""
        scale = 0 if fine else 1
        if start is None:
            moved = _match_brightness(b.grey, a.grey)
            flow = self._dis(scale, cold=True).calc(a.grey, moved, None)
            return _DenseFlow(flow, self._on_grid(_roughness(flow)))
        shape = (self.grid.height, self.grid.width, 2)
        warp = np.clip(start - self._pixels, -1e4, 1e4).reshape(shape).astype(np.float32)
        warp = cv2.remap(
            warp, self._up_u, self._up_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        moved = _match_brightness(self._warp(b.grey, warp, cv2.INTER_CUBIC), a.grey)
        rest = self._dis(scale).calc(a.grey, moved, None)
        flow = rest + self._warp(warp, rest, cv2.INTER_LINEAR)
        return _DenseFlow(flow, self._on_grid(_roughness(rest)))

    def _match(
        self, image: ClassicalImage, there: _DenseFlow, back: _DenseFlow, scale: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Positions on the grid and their weights."""
        f = self._on_grid(there.flow)
        q = self._pixels + f
        disagreement = np.linalg.norm(f + self._sample(back.flow, q, FAR), axis=-1)
        camera = self.grid.camera
        inside = (q > 1).all(-1) & (q < [camera.width - 2, camera.height - 2]).all(-1)
        ok = inside & (disagreement < MAX_DISAGREEMENT)
        weight = ok / (scale * match_deviation(disagreement, there.roughness)) ** 2
        # Without texture the flow stays where it started, smooth and consistent but uninformed.
        weight = weight * np.minimum(1.0, image.structure / 2 + 0.01)
        q = np.where(np.isfinite(q), q, FAR).astype(np.float32)
        return q, np.repeat(weight[:, None], 2, 1).astype(np.float32)

    def _on_grid(self, image: np.ndarray) -> np.ndarray:
        return image[OFFSET:-3:STRIDE, OFFSET:-3:STRIDE].reshape(self.grid.size, *image.shape[2:])

    def _sample(self, image: np.ndarray, points: np.ndarray, outside: float) -> np.ndarray:
        u, v = (points[None, :, k].astype(np.float32) for k in (0, 1))
        out = cv2.remap(
            image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=[outside] * 4
        )
        return out[0]

    def _warp(self, image: np.ndarray, flow: np.ndarray, interpolation: int) -> np.ndarray:
        return cv2.remap(
            image,
            self._u + flow[..., 0],
            self._v + flow[..., 1],
            interpolation,
            borderMode=cv2.BORDER_REPLICATE,
        )


def match_deviation(
    disagreement: Float[np.ndarray, "p"], roughness: Float[np.ndarray, "p"]
) -> Float[np.ndarray, "p"]:
    """Standard deviation of a match along any direction, pixels.

    Fitted to true flow of rendered rooms, given the forward-backward disagreement in pixels and the
    mean gradient of the flow left after warping, which is large at occlusions and where texture is
    missing; image structure and photometric difference add little. It is 1.4 times the deviation
    of a single match, because the errors of a cell are alike in all its edges and the bundle
    adjustment takes them for independent.
    """
    return 0.06 + 0.8 * disagreement + 3.4 * roughness


def _match_brightness(
    image: UInt8[np.ndarray, "h w"], reference: UInt8[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w"]:
    """The image with the slowly varying brightness of the reference; light and gain drop out."""
    gain = (_local_mean(reference) + 4.0) / (_local_mean(image) + 4.0)
    gain = cv2.resize(np.clip(gain, 0.2, 5.0), image.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.clip((image + np.float32(4.0)) * gain - 4.0, 0, 255).astype(np.uint8)


def _local_mean(image: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "r c"]:
    """Over about an eighth of the long edge, at an eighth of the resolution."""
    size = (max(image.shape[1] // 8, 1), max(image.shape[0] // 8, 1))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return cv2.GaussianBlur(small, (0, 0), max(size) / 16)


def _roughness(flow: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w"]:
    """Norm of the flow's gradient, averaged over 9 x 9 pixels."""
    gx = cv2.Sobel(flow, cv2.CV_32F, 1, 0, scale=1 / 8)
    gy = cv2.Sobel(flow, cv2.CV_32F, 0, 1, scale=1 / 8)
    return cv2.blur(np.sqrt((gx * gx + gy * gy).sum(-1)), (9, 9))


def _smaller_eigenvalue(grey: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Of the structure tensor averaged over 9 x 9 pixels, grey levels^2 / pixel^2."""
    gx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8)
    gy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=1 / 8)
    xx, yy, xy = (cv2.boxFilter(p, -1, (9, 9)) for p in (gx * gx, gy * gy, gx * gy))
    return (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
