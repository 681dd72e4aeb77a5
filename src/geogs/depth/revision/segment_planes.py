"""Bare segments of an image as planes, told by what is known at their rims.

Nothing can be matched on a bare wall or door, and what a search finds there is bowed, or of what
the door reflects. What is around it, and its few marks, can be matched. Where most of that lies on
one plane, the segment does, too (segment-based stereo: Tao, Sawhney and Kumar 2001; Bleyer and
Gelautz 2005). What the search is sure of stays as it is, so that what is curved and seen is not
flattened.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int, Int32

from geogs.depth.depth_view import DenseDepth, KeyframeDepth
from geogs.geometry.camera import Camera

RIM = 0.0125
"""Long edges of the image around a segment that say where it lies."""
SURE, UNSURE = 0.7, 0.5
"""Confidence from which a pixel says so, and up to which it takes the plane's depth."""
TOLERANCE = 0.02
"""Relative distance in inverse depth from a plane within which a pixel lies on it."""
MOST_PLANES, LEAST_SHARE = 3, 0.35
"""Planes of a segment, as of a wall around a corner, and the part of what is known (by confidence)
that each explains at least."""
MOSTLY = 0.6
"""Part of what is sure at the rim of an unsure part that lies on a plane."""
STABLE = 0.01
"""Largest relative deviation with which a plane is gone on with."""
ALIKE = 25
"""Pixels that err alike: of so many one counts for the deviation."""
CONFIDENCE = 0.5
"""Of a depth that is a segment's plane, about as measured."""
SKY = 0.2
"""Part of a segment from which sky makes all of it none of these."""
FARTHEST = 5.0
"""Times nearer or farther than what was found a plane may be at a pixel."""
_LEAST, _MOST, _TRIES, _ROUNDS = 40, 750, 64, 4
"""Pixels that a fit needs and takes, triples of them that are tried, and fits of the inliers."""


def planar_depth(
    labels: Int32[np.ndarray, "sh sw"], found: DenseDepth, camera: Camera, seed: int
) -> DenseDepth:
    """A keyframe's depth, what it is unsure of in bare segments of the image being on their planes.

    Args:
        labels: ``bare_segments`` of the image.
        found: the depth.
        camera: of the depth.
        seed: of the samples that are tried.
    """
    device = found.depth.device
    sky = None if found.sky is None else found.sky.cpu().numpy()
    planar = on_planes(found.arrays(), labels, sky, seed)
    if not len(planar.pixels):
        return found
    pixels = torch.from_numpy(planar.pixels).to(device)
    depth, confidence, normal = found.depth.clone(), found.confidence.clone(), found.normal
    depth.view(-1)[pixels] = torch.from_numpy(planar.depth).to(device)
    confidence.view(-1)[pixels] = CONFIDENCE
    if normal is not None:
        normal = normal.clone()
        normal.view(-1, 3)[pixels] = torch.from_numpy(planar.normals(camera)).to(device)
    return replace(found, depth=depth, confidence=confidence, normal=normal)


@dataclass(frozen=True)
class PlanarDepth:
    """Pixels on planes of segments that are known well, where the depth that was found is not."""

    pixels: Int[np.ndarray, "n"]
    """Flat indices."""
    depth: Float32[np.ndarray, "n"]
    """z of the planes there."""
    plane: Int32[np.ndarray, "n"]
    """Which that is."""
    coefficients: Float64[np.ndarray, "p 3"]
    """Of inverse depth in x and y over the image's width and height, from its middle, and 1."""

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
    """Depth by the planes of segments.

    Args:
        found: depth and confidence.
        labels: ``bare_segments`` of the image.
        sky: where nothing is.
        seed: of the samples that are tried.
    """
    from geogs.depth.revision.segment_plane_kernels import planar_pixels

    planes, which = _planes_of_segments(found, labels, sky, np.random.default_rng(seed))
    which = _resized(which, found.depth.shape)
    pixels, depth = np.empty(which.size, np.int64), np.empty(which.size, np.float32)
    count = planar_pixels(
        which, planes, found.depth, found.confidence, UNSURE, FARTHEST, pixels, depth
    )
    taken = pixels[:count]
    return PlanarDepth(taken, depth[:count], which.ravel()[taken] - 1, planes)


def _planes_of_segments(
    found: KeyframeDepth,
    labels: Int32[np.ndarray, "sh sw"],
    sky: Bool[np.ndarray, "h w"] | None,
    rng: np.random.Generator,
) -> tuple[Float64[np.ndarray, "p 3"], Int32[np.ndarray, "sh sw"]]:
    """Planes, and which of them, from 1 on, the pixels of the segments lie on where that is known
    well; 0 for none.

    Of an unsure part at whose own rim most of what is sure lies on no plane nothing is known: a
    segment may go on beyond an edge that is too faint to be seen.
    """
    from geogs.depth.revision import segment_plane_kernels as kernels

    shape = labels.shape
    depth, confidence = (_resized(m, shape) for m in (found.depth, found.confidence))
    is_sky = np.zeros(shape, bool) if sky is None else _resized(sky.view(np.uint8), shape) > 0
    unsure, sure = confidence <= UNSURE, confidence > SURE
    boxes, counts = (np.empty((int(labels.max(initial=0)), k), np.int64) for k in (4, 3))
    kernels.segment_boxes(labels, unsure, is_sky, boxes, counts)
    worth_it = np.flatnonzero((counts[:, 1] >= _LEAST) & (counts[:, 2] <= SKY * counts[:, 0]))
    draws = rng.random((MOST_PLANES * len(worth_it), _TRIES, 3))
    rules = kernels.PlaneRules(
        max(1, round(RIM * max(shape))), TOLERANCE, LEAST_SHARE, MOSTLY, ALIKE, _LEAST, _MOST,
        _ROUNDS,
    )  # fmt: skip
    which, parts, told, alone = np.zeros((4, *shape), np.int32)
    planes, drawn = [np.empty((0, 3))], 0
    for label, box in zip(worth_it + 1, boxes[worth_it], strict=True):
        own, covariances, tried, known, of = kernels.planes_of_segment(
            labels, label, box, unsure, sure, depth, confidence, draws[drawn : drawn + MOST_PLANES],
            rules, parts, told,
        )  # fmt: skip
        drawn += tried
        nearest = alone if len(own) < 2 else _nearest(len(own), known, of, shape)
        first = 1 + sum(map(len, planes))
        kernels.mark_stable(told, label, nearest, box, own, covariances, STABLE, first, which)
        planes.append(own)
    return np.concatenate(planes), which


def _nearest(
    count: int, known: Int[np.ndarray, "n"], of: Int32[np.ndarray, "n"], shape: tuple[int, ...]
) -> Int32[np.ndarray, "h w"]:
    """On which plane that of the known pixels lies that is nearest to each pixel."""
    distances = []
    for number in range(1, count + 1):
        empty = np.ones(shape, np.uint8)
        empty.ravel()[known[of == number]] = 0
        distances.append(cv2.distanceTransform(empty, cv2.DIST_L2, 5))
    return np.argmin(distances, 0).astype(np.int32)


def _resized(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Those of the nearest pixels at another size of the same image."""
    if values.shape == shape:
        return values
    return cv2.resize(values, shape[::-1], interpolation=cv2.INTER_NEAREST)
