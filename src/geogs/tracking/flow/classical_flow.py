"""Flow without a network: dense inverse search of the residual flow after reprojection.

The second image is warped into the first by the reprojection and adjusted to its local brightness,
OpenCV's DIS flow is computed on the pair and the warp is added back, so wide baselines are matched
as well as narrow ones. Both directions are computed; their disagreement and the roughness of the
residual flow give the variance of a match.
"""

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from geogs.threads import opencv_on_one_thread, worker_count
from geogs.tracking.flow.cell_texture import cell_structure, common_tensor, structure_of
from geogs.tracking.flow.flow_operator import Memories
from geogs.types import FlowMatch
from geogs.world.grid import OFFSET, STRIDE, SampleGrid

FAR = 1e3
"""Value for positions outside the image, in pixels."""
MAX_DISAGREEMENT = 1.0
"""Largest difference in pixels of forward and backward flow of a match."""
DEVIATION = (0.06, 0.8, 3.4)
"""Standard deviation of a match: constant (pixels), by disagreement, by roughness."""
COARSE_DEVIATION = 1.7
"""Deviation of a match at half resolution relative to full resolution."""
SMALL_IMAGE = 400
"""Long edge in pixels up to which every measurement is at full resolution."""


@dataclass(frozen=True)
class ClassicalImage:
    """An image encoded by the classical operator."""

    grey: UInt8[np.ndarray, "h w"]
    half: UInt8[np.ndarray, "h2 w2"]
    """The same at half resolution; its pixel x is 2 x + 1/2 of the image."""
    textured: float
    """Fraction of the grid that has texture."""


class StartFlow:
    """Interpolant of known flow, by which the second image is warped, on at least 2 x 2 cells.

    Linear interpolation is not enough. The flow of a slanted plane, such as a road, is curved
    within the eight pixels from one cell to the next, by up to a pixel and always to the same side.
    The flow measured on top of it is smooth and would include the mean of that: along a street
    matches of the ground were too short by a tenth to a third of a pixel, and the scale of the path
    drifted. So the interpolant is quadratic, and stays linear where the flow jumps or has a kink.

    ``f(u, v) = linear - a (1 - a) / 2 X - b (1 - b) / 2 Y``, a and b being the fractions of the way
    from one cell to the next along u and v. X and Y are second differences along the two, each the
    smaller one of the cells at both ends, zero if their signs differ (minmod): it is exact for
    quadratics along either axis, and never overshoots at a step. Source: the limited
    reconstructions of Harten et al. 1987 (ENO).
    """

    def __init__(self, flow: Float[np.ndarray, "r c 2"]) -> None:
        self._flow = np.ascontiguousarray(flow, np.float32)
        self._bend_u, self._bend_v = _limited_bend(self._flow, 1), _limited_bend(self._flow, 0)

    def on(self, lattice: "Lattice") -> Float32[np.ndarray, "h w 2"]:
        """Interpolate at all points of a lattice made for this grid."""
        x = lattice
        height = len(x.u)
        found = _bilinear(self._flow, x.u, x.v)
        # Both components of a row in one axis: NumPy is slow on axes of two.
        flat = found.reshape(height, -1)
        flat -= x.factor_u * _bilinear(self._bend_u, x.cell_u, x.v).reshape(height, -1)
        flat -= x.factor_v * _bilinear(self._bend_v, x.u, x.cell_v).reshape(height, -1)
        return found

    def at(self, points: Float[np.ndarray, "p 2"]) -> Float32[np.ndarray, "p 2"]:
        """Interpolate at some points, in cells. The border is replicated."""
        rows, columns = self._flow.shape[:2]
        i, a = _cells(points[:, 0].astype(np.float32), columns)
        j, b = _cells(points[:, 1].astype(np.float32), rows)
        i, j, a, b = i.astype(int), j.astype(int), a[:, None], b[:, None]

        def along_u(field: np.ndarray, row: np.ndarray) -> np.ndarray:
            return (1 - a) * field[row, i] + a * field[row, i + 1]

        linear = (1 - b) * along_u(self._flow, j) + b * along_u(self._flow, j + 1)
        bend_u = (1 - b) * self._bend_u[j, i] + b * self._bend_u[j + 1, i]
        bend_v = along_u(self._bend_v, j)
        found: np.ndarray = linear - 0.5 * (a * (1 - a) * bend_u + b * (1 - b) * bend_v)
        return found


class Lattice:
    """Columns u and rows v, in cells of a grid, with precomputed data for interpolation."""

    def __init__(
        self, u: Float32[np.ndarray, "w"], v: Float32[np.ndarray, "h"], rows: int, columns: int
    ) -> None:
        """Positions are multiples of 1/32, to which OpenCV rounds; ``rows``, ``columns``: cells."""
        self.u, self.v = np.meshgrid(u, v)
        cell, fraction = _cells(u, columns)
        self.cell_u = np.meshgrid(cell, v)[0]
        self.factor_u = (0.5 * fraction * (1 - fraction)).repeat(2)
        cell, fraction = _cells(v, rows)
        self.cell_v = np.meshgrid(u, cell)[1]
        self.factor_v = (0.5 * fraction * (1 - fraction))[:, None]


def _cells(x: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the cell before each point, and the fraction of the way to the next."""
    x = np.clip(x, 0, count - 1)
    cell = np.minimum(np.floor(x), count - 2)
    return cell, x - cell


def _limited_bend(flow: Float32[np.ndarray, "r c 2"], axis: int) -> Float32[np.ndarray, "r c 2"]:
    """Return second differences between each cell and the next along an axis; zero for the last."""
    bend = np.zeros_like(flow)
    if flow.shape[axis] < 3:
        return bend
    second = np.diff(flow, 2, axis)
    # At the border there is only one.
    both = np.concatenate([second.take([0], axis), second, second.take([-1], axis)], axis)
    first, last = (both.take(range(k, k + flow.shape[axis] - 1), axis) for k in (0, 1))
    smaller = np.where(np.abs(first) < np.abs(last), first, last)
    inner = bend[:, :-1] if axis == 1 else bend[:-1]
    inner[...] = np.where(first * last > 0, smaller, 0)
    return bend


class _Level:
    """Coordinates of an image pyramid's level of 1 or 1/2 resolution."""

    def __init__(self, grid: SampleGrid, step: int) -> None:
        self.step = step
        width, height = -(-grid.camera.width // step), -(-grid.camera.height // step)
        v, u = np.mgrid[:height, :width].astype(np.float32)
        self.u, self.v = u, v
        # The pixels in units of the grid's cells.
        across, down = ((self.to_image(x) - OFFSET) / STRIDE for x in (u[0], v[:, 0]))
        self.lattice = Lattice(across, down, grid.height, grid.width)

    def to_image(self, x: np.ndarray) -> np.ndarray:
        """Convert coordinates of this level to the full image."""
        return self.step * x + np.float32((self.step - 1) / 2)

    def from_image(self, x: np.ndarray) -> np.ndarray:
        """Convert coordinates of the full image to this level."""
        return (x - np.float32((self.step - 1) / 2)) / self.step


@dataclass(frozen=True)
class _DenseFlow:
    """A known warp, the dense residual flow, and the images of the latter."""

    level: _Level
    warp: StartFlow | None
    """Warp in image pixels, over cells of the grid."""
    rest: np.ndarray
    """Residual flow on the level's pixels, in level pixels."""
    source: UInt8[np.ndarray, "a b"]
    target: UInt8[np.ndarray, "a b"]
    """Second image, already warped."""

    def at(self, points: Float[np.ndarray, "p 2"], outside: float) -> Float[np.ndarray, "p 2"]:
        """Return the flow of image points; ``outside`` where they are not in the image."""
        moved = self.level.step * _sample(self.rest, self.level.from_image(points), outside)
        if self.warp is None:
            return moved
        return moved + self.warp.at((points + moved - OFFSET) / STRIDE)

    def roughness(self, points: Float[np.ndarray, "p 2"]) -> Float[np.ndarray, "p"]:
        """Return the norm of the residual flow's gradient around image points."""
        gx = cv2.Sobel(self.rest, cv2.CV_32F, 1, 0, scale=1 / 8)
        gy = cv2.Sobel(self.rest, cv2.CV_32F, 0, 1, scale=1 / 8)
        norm = cv2.sqrt(cv2.transform(gx * gx + gy * gy, np.ones((1, 2), np.float32)))
        window = 8 // self.level.step + 1
        return _sample(cv2.blur(norm, (window, window)), self.level.from_image(points), None)

    def certainty(self, points: Float[np.ndarray, "p 2"]) -> Float[np.ndarray, "p 2"]:
        """Return the certainty of matches of image points along x and y, by common texture."""
        level = self.level
        found = _warped(self.target, level.u + self.rest[..., 0], level.v + self.rest[..., 1])
        tensor = common_tensor(self.source, found, 8 // level.step + 1)
        # Gradients of the level are per pixel of the level.
        at = level.from_image(points)
        return structure_of(*(_sample(p, at, None) / level.step**2 for p in tensor)).certainty


class ClassicalFlow:
    """The DIS operator on one grid; directions and images are matched in parallel threads."""

    def __init__(self, grid: SampleGrid) -> None:
        opencv_on_one_thread()
        self.grid = grid
        self._local = threading.local()
        self._full = _Level(grid, 1)
        self._half = _Level(grid, 2)
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
        # A small image at half resolution is too small for matching.
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
        """Return workers of the calling thread: a frame does not wait for a keyframe's matching."""
        found: ThreadPoolExecutor | None = getattr(self._local, "pool", None)
        if found is None:
            found = self._local.pool = ThreadPoolExecutor(worker_count())
        return found

    def _dis(self, cold: bool) -> cv2.DISOpticalFlow:
        """Return this thread's flow object, for unwarped or warped pairs."""
        name = "cold" if cold else "warm"
        found = getattr(self._local, name, None)
        if found is None:
            # OpenCV's stubs have the class, but not its factory.
            found = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # type: ignore[attr-defined]
            found.setFinestScale(0)
            if not cold:
                # Measured: as precise as the preset on warped pairs, in half its time.
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
        """Compute flow from a to b, starting from positions ``start`` in b."""
        level = self._full if fine else self._half
        source, target = (x.grey if fine else x.half for x in (a, b))
        warp = None
        if start is not None:
            shape = (self.grid.height, self.grid.width, 2)
            warp = StartFlow(np.clip(start - self._pixels, -1e4, 1e4).reshape(shape))
            dense = warp.on(level.lattice) / level.step
            target = _warped(target, level.u + dense[..., 0], level.v + dense[..., 1])
        target = _match_brightness(target, source)
        # OpenCV allocates the output for None, which its stubs do not allow.
        flow = self._dis(start is None).calc(source, target, None)  # type: ignore[call-overload]
        return _DenseFlow(level, warp, flow, source, target)

    def _match(self, there: _DenseFlow, back: _DenseFlow) -> tuple[np.ndarray, np.ndarray]:
        """Return matched positions of the grid's cells and their weights."""
        flow = there.at(self._pixels, 0.0)
        q = self._pixels + flow
        disagreement = np.linalg.norm(flow + back.at(q, FAR), axis=-1)
        camera = self.grid.camera
        inside = (q > 1).all(-1) & (q < [camera.width - 2, camera.height - 2]).all(-1)
        ok = inside & (disagreement < MAX_DISAGREEMENT)
        deviation = match_deviation(disagreement, there.roughness(self._pixels))
        if there.level.step > 1:
            deviation = deviation * COARSE_DEVIATION
        # Without texture the flow stays at its start, smooth and consistent but uninformed.
        weight = (ok / deviation**2)[:, None] * there.certainty(self._pixels)
        q = np.where(np.isfinite(q), q, FAR).astype(np.float32)
        return q, weight.astype(np.float32)


def _sample(
    image: np.ndarray, points: Float[np.ndarray, "p 2"], outside: float | None
) -> np.ndarray:
    """Interpolate at points bilinearly; ``outside`` beyond the border, None replicates it."""
    u, v = (points[None, :, k].astype(np.float32) for k in (0, 1))
    return _bilinear(image, u, v, outside)[0]


def _bilinear(
    field: np.ndarray, u: np.ndarray, v: np.ndarray, outside: float | None = None
) -> np.ndarray:
    """Interpolate a field at columns and rows bilinearly; ``outside`` as above."""
    border = cv2.BORDER_REPLICATE if outside is None else cv2.BORDER_CONSTANT
    value = [outside or 0.0] * 4
    return cv2.remap(field, u, v, cv2.INTER_LINEAR, borderMode=border, borderValue=value)


def match_deviation(
    disagreement: Float[np.ndarray, "p"], roughness: Float[np.ndarray, "p"]
) -> Float[np.ndarray, "p"]:
    """Return the standard deviation of a match along any direction, pixels.

    Fitted to true flow of rendered rooms, given the forward-backward disagreement in pixels and the
    mean gradient of the flow left after warping, which is large at occlusions and where texture is
    missing; image structure and photometric difference add little. It is 1.4 times the deviation of
    a single match, because the errors of a cell are correlated over its edges, but the bundle
    adjustment assumes them to be independent.
    """
    constant, by_disagreement, by_roughness = DEVIATION
    return constant + by_disagreement * disagreement + by_roughness * roughness


def _warped(
    image: UInt8[np.ndarray, "h w"], x: Float[np.ndarray, "a b"], y: Float[np.ndarray, "a b"]
) -> UInt8[np.ndarray, "a b"]:
    from geogs.tracking.flow.flow_kernels import warp

    warped = np.empty(x.shape, np.uint8)
    warp(image, x, y, warped)
    return warped


def _match_brightness(
    image: UInt8[np.ndarray, "h w"], reference: UInt8[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w"]:
    """Adjust the local brightness of an image to the reference, to cancel light and gain."""
    ratio = (_local_mean(reference) + 4.0) / (_local_mean(image) + 4.0)
    gain = cv2.resize(np.clip(ratio, 0.2, 5.0), image.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.clip((image + np.float32(4.0)) * gain - 4.0, 0, 255).astype(np.uint8)


def _local_mean(image: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "r c"]:
    """Return the mean over about an eighth of the long edge, at an eighth of the resolution."""
    size = (max(image.shape[1] // 8, 1), max(image.shape[0] // 8, 1))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return cv2.GaussianBlur(small, (0, 0), max(size) / 16)
