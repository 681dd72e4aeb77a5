"""Bare segments of an image as planes through the confident depths at their rims.

Nothing can be matched on a bare wall or door: searched depths there are bowed, or those of
reflections. The surroundings and a few marks can be matched. Where most of these lie on one plane,
the segment does, too (segment-based stereo: Tao, Sawhney and Kumar 2001; Bleyer and Gelautz 2005).
Confident depths stay, so curved surfaces that were matched are not flattened.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int, Int32, UInt8

from geogs.depth.depth_view import DenseDepth, KeyframeDepth
from geogs.geometry.camera import Camera

RIM_WIDTH = 0.0125
"""Width of the rim around a segment, in long edges of the image."""
CONFIDENT, UNCERTAIN = 0.7, 0.5
"""Confidence above which a depth supports a plane, and up to which the plane's replaces it."""
MOST_PLANES = 3
"""Most planes of a segment, as of a wall around a corner."""
MAX_DEVIATION = 0.01
"""Largest relative standard deviation of a plane's inverse depth at a pixel that takes it."""
CONFIDENCE = 0.5
"""Confidence of a depth on a segment's plane, about as measured."""
MAX_SKY = 0.2
"""Fraction of sky above which a segment has no planes."""
MAX_DEPTH_RATIO = 5.0
"""Largest ratio, either way, of the searched depth to that of a plane."""
_SAMPLES = 64
"""Samples of three pixels that are tried for a plane."""
EDGE = 320
"""Longest edge of the image that is searched, pixels."""
SMOOTHING = 1.2
"""Standard deviation of the blur that removes noise, pixels of that image."""
MAX_GRADIENT = 2.0
"""Largest gradient, grey levels a pixel, of any channel in a bare part."""
MIN_AREA = 0.003
"""Least area of a segment, as a fraction of the image."""


def bare_segments(image: UInt8[np.ndarray, "ih iw 3"]) -> Int32[np.ndarray, "h w"]:
    """Labels from 1 on of the connected bare parts of an image, 0 elsewhere, at its size or that of
    ``EDGE``, whichever is smaller."""
    height, width = image.shape[:2]
    factor = min(1.0, EDGE / max(height, width))
    size = max(3, round(width * factor)), max(3, round(height * factor))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(small.astype(np.float32), (0, 0), SMOOTHING)
    change = np.zeros(smooth.shape[:2], np.float32)
    for channel in cv2.split(smooth):
        across = cv2.absdiff(channel[:, 2:], channel[:, :-2])
        down = cv2.absdiff(channel[2:], channel[:-2])
        change[:, 1:-1] = np.maximum(change[:, 1:-1], across)
        change[1:-1] = np.maximum(change[1:-1], down)
    is_bare = (change < 2 * MAX_GRADIENT).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(is_bare, connectivity=4)
    is_large = stats[:, cv2.CC_STAT_AREA] > MIN_AREA * labels.size
    is_large[0] = False
    return (np.cumsum(is_large) * is_large).astype(np.int32)[labels]


def planar_depth(
    labels: Int32[np.ndarray, "sh sw"], found: DenseDepth, camera: Camera, seed: int
) -> DenseDepth:
    """Put the uncertain pixels of a keyframe's depth in bare segments of the image on planes.

    Args:
        labels: ``bare_segments`` of the image.
        found: the searched depth.
        camera: camera of the depth.
        seed: seed of the random samples.
    """
    device = found.depth.device
    sky = None if found.sky is None else found.sky.cpu().numpy()
    planar = on_planes(found.arrays(), labels, sky, seed)
    if not len(planar.pixels):
        return found
    pixels = torch.from_numpy(planar.pixels).to(device)
    depth = found.depth.clone()
    confidence = found.confidence.clone()
    normal = found.normal
    depth.view(-1)[pixels] = torch.from_numpy(planar.depth).to(device)
    confidence.view(-1)[pixels] = CONFIDENCE
    if normal is not None:
        normal = normal.clone()
        normal.view(-1, 3)[pixels] = torch.from_numpy(planar.normals(camera)).to(device)
    return replace(found, depth=depth, confidence=confidence, normal=normal)


@dataclass(frozen=True)
class PlanarDepth:
    """Uncertain pixels of a depth that lie on well known planes of segments."""

    pixels: Int[np.ndarray, "n"]
    """Flat pixel indices."""
    depth: Float32[np.ndarray, "n"]
    """z on the planes."""
    plane: Int32[np.ndarray, "n"]
    """Index of each pixel's plane."""
    coefficients: Float64[np.ndarray, "p 3"]
    """Coefficients of inverse depth in x, y and 1; x and y are fractions of the image's width and
    height from its middle."""

    def normals(self, camera: Camera) -> Float32[np.ndarray, "n 3"]:
        """Unit normals, camera frame and facing it.

        With 1 / z = a u + b v + c a point X of the plane has n X = 1 for
        n = (a fx, b fy, a cx + b cy + c).
        """
        a, b = self.coefficients[:, 0] / camera.width, self.coefficients[:, 1] / camera.height
        middle_u, middle_v = (camera.width - 1) / 2, (camera.height - 1) / 2
        c = self.coefficients[:, 2] - a * middle_u - b * middle_v
        n = np.stack([a * camera.fx, b * camera.fy, a * camera.cx + b * camera.cy + c], -1)
        return (-n / np.linalg.norm(n, axis=-1, keepdims=True)).astype(np.float32)[self.plane]


def on_planes(
    found: KeyframeDepth,
    labels: Int32[np.ndarray, "sh sw"],
    sky: Bool[np.ndarray, "h w"] | None,
    seed: int,
) -> PlanarDepth:
    """Find the pixels on planes of the segments ``labels``; other arguments as ``planar_depth``."""
    from geogs.depth.revision.segment_plane_kernels import planar_pixels

    planes, which = _planes_of_segments(found, labels, sky, np.random.default_rng(seed))
    which = _resized(which, found.depth.shape)
    pixels = np.empty(which.size, np.int64)
    depth = np.empty(which.size, np.float32)
    count = planar_pixels(
        which, planes, found.depth, found.confidence, UNCERTAIN, MAX_DEPTH_RATIO, pixels, depth
    )
    taken = pixels[:count]
    return PlanarDepth(taken, depth[:count], which.ravel()[taken] - 1, planes)


def _planes_of_segments(
    found: KeyframeDepth,
    labels: Int32[np.ndarray, "sh sw"],
    sky: Bool[np.ndarray, "h w"] | None,
    rng: np.random.Generator,
) -> tuple[Float64[np.ndarray, "p 3"], Int32[np.ndarray, "sh sw"]]:
    """Planes, and the number, from 1 on, of the plane of each pixel of the segments; 0 for none.

    An uncertain part has none if most of the confident pixels at its own rim lie on no plane: a
    segment may extend beyond an edge that is too faint to be seen.
    """
    from geogs.depth.revision import segment_plane_kernels as kernels

    shape = labels.shape
    depth, confidence = (_resized(m, shape) for m in (found.depth, found.confidence))
    is_sky = np.zeros(shape, bool) if sky is None else _resized(sky.view(np.uint8), shape) > 0
    uncertain = confidence <= UNCERTAIN
    confident = confidence > CONFIDENT
    boxes, counts = (np.empty((int(labels.max(initial=0)), k), np.int64) for k in (4, 3))
    kernels.segment_boxes(labels, uncertain, is_sky, boxes, counts)
    total, doubtful, of_sky = counts.T
    rules = kernels.PlaneRules(max(1, round(RIM_WIDTH * max(shape))))
    worth_it = np.flatnonzero((doubtful >= rules.min_pixels) & (of_sky <= MAX_SKY * total))
    draws = rng.random((MOST_PLANES * len(worth_it), _SAMPLES, 3))
    which, parts, marked, alone = np.zeros((4, *shape), np.int32)
    planes = [np.empty((0, 3))]
    drawn = 0
    for label, box in zip(worth_it + 1, boxes[worth_it], strict=True):
        own, covariances, tried, known, of = kernels.planes_of_segment(
            labels, label, box, uncertain, confident, depth, confidence,
            draws[drawn : drawn + MOST_PLANES], rules, parts, marked,
        )  # fmt: skip
        drawn += tried
        nearest = alone if len(own) < 2 else _nearest(len(own), known, of, shape)
        first = 1 + sum(map(len, planes))
        kernels.mark_stable(
            marked, label, nearest, box, own, covariances, MAX_DEVIATION, first, which
        )
        planes.append(own)
    return np.concatenate(planes), which


def _nearest(
    count: int, known: Int[np.ndarray, "n"], of: Int32[np.ndarray, "n"], shape: tuple[int, ...]
) -> Int32[np.ndarray, "h w"]:
    """The plane, from 0 on, of the known pixel that is nearest to each pixel."""
    distances = []
    for number in range(1, count + 1):
        empty = np.ones(shape, np.uint8)
        empty.ravel()[known[of == number]] = 0
        distances.append(cv2.distanceTransform(empty, cv2.DIST_L2, 5))
    return np.argmin(distances, 0).astype(np.int32)


def _resized(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Values of the nearest pixels at another size of the same image."""
    if values.shape == shape:
        return values
    return cv2.resize(values, shape[::-1], interpolation=cv2.INTER_NEAREST)
