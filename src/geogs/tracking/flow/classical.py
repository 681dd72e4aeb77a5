"""Flow without a network: dense inverse search on what the present reprojection leaves over.

The second image is warped into the first by the reprojection, OpenCV's DIS flow is computed on the
pair and the warp is added back, so wide baselines are matched as well as narrow ones. Both
directions are computed; their disagreement, the photometric difference and the image structure give
the variance of a match.
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


@dataclass(frozen=True)
class ClassicalImage:
    """An image as the classical operator keeps it."""

    grey: UInt8[np.ndarray, "h w"]
    """Brightness divided by its local mean, 100 where they are equal."""
    structure: Float[np.ndarray, "p"]
    """Smaller eigenvalue of the structure tensor on the grid, grey levels^2 / pixel^2."""


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
        grey = _flatten_illumination(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        return ClassicalImage(grey, self._on_grid(_smaller_eigenvalue(grey)))

    def texture(self, encoded: ClassicalImage) -> float:
        return float((encoded.structure > 2.0).mean())

    def measure(
        self,
        first: Sequence[ClassicalImage],
        second: Sequence[ClassicalImage],
        forward: Float[Tensor, "e p 2"] | None = None,
        backward: Float[Tensor, "e p 2"] | None = None,
        fine: bool = True,
    ) -> tuple[FlowMatch, FlowMatch]:
        a = [*first, *second]
        b = [*second, *first]
        n = len(first)
        start = [None] * (2 * n)
        if forward is not None and backward is not None:
            start = list(torch.cat([forward, backward]).cpu().numpy())
        flows = list(self._pool.map(lambda x, y, s: self._dense(x, y, s, fine), a, b, start))
        reverse = [*flows[n:], *flows[:n]]
        matches = list(self._pool.map(self._match, a, b, flows, reverse))
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
    ) -> np.ndarray:
        """Flow from a to b on every pixel."""
        scale = 0 if fine else 1
        if start is None:
            return self._dis(scale, cold=True).calc(a.grey, b.grey, None)
        shape = (self.grid.height, self.grid.width, 2)
        warp = np.clip(start - self._pixels, -1e4, 1e4).reshape(shape).astype(np.float32)
        warp = cv2.remap(
            warp, self._up_u, self._up_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        moved = self._warp(b.grey, warp, cv2.INTER_CUBIC)
        rest = self._dis(scale).calc(a.grey, moved, None)
        return rest + self._warp(warp, rest, cv2.INTER_LINEAR)

    def _match(
        self, a: ClassicalImage, b: ClassicalImage, flow: np.ndarray, reverse: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Positions on the grid and their weights."""
        f = self._on_grid(flow)
        q = self._pixels + f
        back = self._sample(reverse, q, FAR)
        disagreement = np.linalg.norm(f + back, axis=-1)
        camera = self.grid.camera
        inside = (q > 1).all(-1) & (q < [camera.width - 2, camera.height - 2]).all(-1)
        ok = inside & (disagreement < 1.0)
        weight = ok * match_weight(disagreement, a.structure)
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


def match_weight(
    disagreement: Float[np.ndarray, "p"], structure: Float[np.ndarray, "p"]
) -> Float[np.ndarray, "p"]:
    """Inverse variance of a match, 1 / pixel^2."""
    return np.minimum(1.0, structure / 4 + 0.02) / (25 * (0.1 + disagreement) ** 2)


def _flatten_illumination(grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Brightness relative to its local mean, so that gain and slow changes of light drop out."""
    image = grey.astype(np.float32) + 10.0
    # The mean is smooth, so an eighth of the resolution is enough.
    size = (max(grey.shape[1] // 8, 1), max(grey.shape[0] // 8, 1))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    mean = cv2.GaussianBlur(small, (0, 0), max(small.shape) / 16)
    mean = cv2.resize(mean, grey.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.clip(100.0 * image / mean, 0, 255).astype(np.uint8)


def _smaller_eigenvalue(grey: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Of the structure tensor averaged over 9 x 9 pixels."""
    gx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8)
    gy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=1 / 8)
    xx, yy, xy = (cv2.boxFilter(p, -1, (9, 9)) for p in (gx * gx, gy * gy, gx * gy))
    return (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
