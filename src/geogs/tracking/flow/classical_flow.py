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

from geogs.threads import opencv_on_one_thread, worker_count
from geogs.tracking.flow.cell_texture import cell_structure, common_tensor, structure_of
from geogs.tracking.flow.flow_operator import Memories
from geogs.tracking.flow.start_flow import Lattice, StartFlow, bilinear
from geogs.types import FlowMatch
from geogs.world.grid import OFFSET, STRIDE, SampleGrid

FAR = 1e3
"""Stands for a position outside the image, in pixels."""
MAX_DISAGREEMENT = 1.0
"""Forward and backward flow that differ by more pixels are no match."""
COARSE_DEVIATION = 1.7
"""Deviation of a match at half resolution relative to full resolution."""
SMALL_IMAGE = 400
"""Long edge in pixels up to which every measurement is at full resolution."""


@dataclass(frozen=True)
class ClassicalImage:
    """An image as the classical operator keeps it."""

    grey: UInt8[np.ndarray, "h w"]
    half: UInt8[np.ndarray, "h2 w2"]
    """The same at half resolution; its pixel x is 2 x + 1/2 of the image."""
    textured: float
    """Fraction of the grid that has texture."""


class _Level:
    """Coordinates of an image pyramid's level of 1 or 1/2 resolution."""

    def __init__(self, grid: SampleGrid, step: int) -> None:
        self.step = step
        width, height = -(-grid.camera.width // step), -(-grid.camera.height // step)
        v, u = np.mgrid[:height, :width].astype(np.float32)
        self.u, self.v = u, v
        # The same pixels in cells of the grid.
        across, down = ((self.to_image(x) - OFFSET) / STRIDE for x in (u[0], v[:, 0]))
        self.lattice = Lattice(across, down, grid.height, grid.width)

    def to_image(self, x: np.ndarray) -> np.ndarray:
        """Coordinates of this level in the full image."""
        return self.step * x + np.float32((self.step - 1) / 2)

    def from_image(self, x: np.ndarray) -> np.ndarray:
        """Coordinates of the full image on this level."""
        return (x - np.float32((self.step - 1) / 2)) / self.step


@dataclass(frozen=True)
class _DenseFlow:
    """A known warp, the dense flow that was left over, and how rough that is."""

    level: _Level
    warp: StartFlow | None
    """Image pixels, over cells of the grid."""
    rest: np.ndarray
    """On the level's pixels, level pixels."""
    source: UInt8[np.ndarray, "a b"]
    target: UInt8[np.ndarray, "a b"]
    """The images that it is the flow between; the latter is warped already."""

    def at(self, points: Float[np.ndarray, "p 2"], outside: float) -> Float[np.ndarray, "p 2"]:
        """Flow of image points; ``outside`` where they are not in the image."""
        moved = self.level.step * _sample(self.rest, self.level.from_image(points), outside)
        if self.warp is None:
            return moved
        return moved + self.warp.at((points + moved - OFFSET) / STRIDE)

    def roughness(self, points: Float[np.ndarray, "p 2"]) -> Float[np.ndarray, "p"]:
        """Norm of the gradient of the rest around image points."""
        gx = cv2.Sobel(self.rest, cv2.CV_32F, 1, 0, scale=1 / 8)
        gy = cv2.Sobel(self.rest, cv2.CV_32F, 0, 1, scale=1 / 8)
        norm = cv2.sqrt(cv2.transform(gx * gx + gy * gy, np.ones((1, 2), np.float32)))
        window = 8 // self.level.step + 1
        return _sample(cv2.blur(norm, (window, window)), self.level.from_image(points), None)

    def certainty(self, points: Float[np.ndarray, "p 2"]) -> Float[np.ndarray, "p 2"]:
        """Certainty of matches of image points along x and y, by what both images show there."""
        level = self.level
        found = _warped(self.target, level.u + self.rest[..., 0], level.v + self.rest[..., 1])
        tensor = common_tensor(self.source, found, 8 // level.step + 1)
        # Gradients of the level are by its own pixels.
        at = level.from_image(points)
        return structure_of(*(_sample(p, at, None) / level.step**2 for p in tensor)).certainty


class ClassicalFlow:
    """The DIS operator on one grid; directions and images are matched side by side in threads."""

    def __init__(self, grid: SampleGrid) -> None:
        opencv_on_one_thread()
        self.grid = grid
        self._local = threading.local()
        self._full, self._half = _Level(grid, 1), _Level(grid, 2)
        self._pixels = grid.pixels.cpu().numpy()

    def encode(self, image: UInt8[np.ndarray, "h w 3"]) -> ClassicalImage:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        even = np.pad(grey, [(0, n % 2) for n in grey.shape], mode="edge")
        half = cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        return ClassicalImage(grey, half, cell_structure(grey).textured_fraction)

    def texture(self, encoded: ClassicalImage) -> float:
        return encoded.textured

    def grey(self, encoded: ClassicalImage) -> Float[Tensor, "h w"]:
        return torch.from_numpy(encoded.grey).to(self.grid.device).float()

    def measure(
        self,
        first: Sequence[ClassicalImage],
        second: Sequence[ClassicalImage],
        forward: Float[Tensor, "e p 2"] | None = None,
        backward: Float[Tensor, "e p 2"] | None = None,
        fine: bool = True,
        memory: Memories | None = None,
    ) -> tuple[FlowMatch, FlowMatch]:
        # Half of a small image is too little to match.
        fine = fine or self.grid.camera.long_edge <= SMALL_IMAGE
        a, b = [*first, *second], [*second, *first]
        n = len(first)
        start = [None] * (2 * n)
        if forward is not None and backward is not None:
            start = list(torch.cat([forward, backward]).cpu().numpy())
        pool = self._workers()
        flows = list(pool.map(lambda x, y, s: self._dense(x, y, s, fine), a, b, start))
        reverse = [*flows[n:], *flows[:n]]
        matches = list(pool.map(self._match, flows, reverse))
        pixels, weight = (
            torch.from_numpy(np.stack(part)).to(self.grid.device)
            for part in zip(*matches, strict=True)
        )
        return FlowMatch(pixels[:n], weight[:n]), FlowMatch(pixels[n:], weight[n:])

    def _workers(self) -> ThreadPoolExecutor:
        """Workers of the calling thread: a frame does not wait behind what a keyframe measures."""
        found: ThreadPoolExecutor | None = getattr(self._local, "pool", None)
        if found is None:
            found = self._local.pool = ThreadPoolExecutor(worker_count())
        return found

    def _dis(self, cold: bool) -> cv2.DISOpticalFlow:
        """This thread's flow object, for unwarped or warped pairs."""
        name = "cold" if cold else "warm"
        found = getattr(self._local, name, None)
        if found is None:
            # OpenCV's stubs know the class, not its factory.
            found = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # type: ignore[attr-defined]
            found.setFinestScale(0)
            if not cold:
                # Measured: as precise as the preset on warped pairs, at half its time.
                found.setGradientDescentIterations(6)
                found.setPatchStride(5)
                found.setVariationalRefinementIterations(3)
            # Smoother, and gradients rather than brightness: less noise, less light.
            found.setVariationalRefinementAlpha(40.0)
            found.setVariationalRefinementDelta(1.0)
            setattr(self._local, name, found)
        return found

    def _dense(
        self, a: ClassicalImage, b: ClassicalImage, start: np.ndarray | None, fine: bool
    ) -> _DenseFlow:
        """Flow from a to b, whose positions in b are about ``start``."""
        level = self._full if fine else self._half
        source, target = (x.grey if fine else x.half for x in (a, b))
        warp = None
        if start is not None:
            shape = (self.grid.height, self.grid.width, 2)
            warp = StartFlow(np.clip(start - self._pixels, -1e4, 1e4).reshape(shape))
            dense = warp.on(level.lattice) / level.step
            target = _warped(target, level.u + dense[..., 0], level.v + dense[..., 1])
        target = _match_brightness(target, source)
        # OpenCV makes the output where None is given, which its stubs do not say.
        flow = self._dis(start is None).calc(source, target, None)  # type: ignore[call-overload]
        return _DenseFlow(level, warp, flow, source, target)

    def _match(self, there: _DenseFlow, back: _DenseFlow) -> tuple[np.ndarray, np.ndarray]:
        """Positions on the grid and their weights."""
        flow = there.at(self._pixels, 0.0)
        q = self._pixels + flow
        disagreement = np.linalg.norm(flow + back.at(q, FAR), axis=-1)
        camera = self.grid.camera
        inside = (q > 1).all(-1) & (q < [camera.width - 2, camera.height - 2]).all(-1)
        ok = inside & (disagreement < MAX_DISAGREEMENT)
        deviation = match_deviation(disagreement, there.roughness(self._pixels))
        if there.level.step > 1:
            deviation = deviation * COARSE_DEVIATION
        # Without texture the flow stays where it started, smooth and consistent but uninformed.
        weight = (ok / deviation**2)[:, None] * there.certainty(self._pixels)
        q = np.where(np.isfinite(q), q, FAR).astype(np.float32)
        return q, weight.astype(np.float32)


def _sample(
    image: np.ndarray, points: Float[np.ndarray, "p 2"], outside: float | None
) -> np.ndarray:
    """Bilinear values at points; ``outside`` beyond the border, None replicates it."""
    u, v = (points[None, :, k].astype(np.float32) for k in (0, 1))
    if outside is None:
        return bilinear(image, u, v)[0]
    return cv2.remap(
        image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=[outside] * 4
    )[0]


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


def _warped(
    image: UInt8[np.ndarray, "h w"], x: Float[np.ndarray, "a b"], y: Float[np.ndarray, "a b"]
) -> UInt8[np.ndarray, "a b"]:
    from geogs.tracking.flow.warp_kernels import warp

    warped = np.empty(x.shape, np.uint8)
    warp(image, x, y, warped)
    return warped


def _match_brightness(
    image: UInt8[np.ndarray, "h w"], reference: UInt8[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w"]:
    """The image with the slowly varying brightness of the reference; light and gain drop out."""
    ratio = (_local_mean(reference) + 4.0) / (_local_mean(image) + 4.0)
    gain = cv2.resize(np.clip(ratio, 0.2, 5.0), image.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.clip((image + np.float32(4.0)) * gain - 4.0, 0, 255).astype(np.uint8)


def _local_mean(image: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "r c"]:
    """Mean over about an eighth of the long edge, at an eighth of the resolution."""
    size = (max(image.shape[1] // 8, 1), max(image.shape[0] // 8, 1))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return cv2.GaussianBlur(small, (0, 0), max(size) / 16)
