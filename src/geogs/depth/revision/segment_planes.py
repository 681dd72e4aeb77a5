"""Bare segments of an image as planes, told by what is known at their rims.

Nothing can be matched on a bare wall or door, and what a search finds there is bowed, or of what
the door reflects. What is around it, and its few marks, can be matched. Where most of that lies on
one plane, the segment does, too (segment-based stereo: Tao, Sawhney and Kumar 2001; Bleyer and
Gelautz 2005). What the search is sure of stays as it is, so that what is curved and seen is not
flattened.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int, Int32, UInt8

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


@dataclass(frozen=True)
class SegmentPlane:
    """Inverse depth as a linear function of the place in the image, and what it was fitted to."""

    coefficients: Float64[np.ndarray, "3"]
    """Of x and y over the image's width and height, from its middle, and of 1."""
    information: Float64[np.ndarray, "3 3"]
    """Sum of the weighted products of (x, y, 1)."""
    on: Bool[np.ndarray, "n"]
    """Which of the pixels that told it lie on it."""
    typical: float
    """Their mean inverse depth."""

    @property
    def covariance(self) -> Float64[np.ndarray, "3 3"]:
        """Of the coefficients: as the fit carries on half the tolerance of its pixels."""
        deviation = TOLERANCE / 2 * self.typical
        return ALIKE * deviation**2 * np.linalg.inv(self.information + 1e-9 * np.eye(3))


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

    shape = found.depth.shape
    planes, which = _planes_of_segments(found, labels, sky, np.random.default_rng(seed))
    which = _resized(which, shape)
    coefficients = np.array([p.coefficients for p in planes]).reshape(-1, 3)
    pixels, depth = np.empty(which.size, np.int64), np.empty(which.size, np.float32)
    count = planar_pixels(
        which, coefficients, found.depth, found.confidence, UNSURE, FARTHEST, pixels, depth
    )
    taken = pixels[:count]
    return PlanarDepth(taken, depth[:count], which.ravel()[taken] - 1, coefficients)


def _planes_of_segments(
    found: KeyframeDepth,
    labels: Int32[np.ndarray, "sh sw"],
    sky: Bool[np.ndarray, "h w"] | None,
    rng: np.random.Generator,
) -> tuple[list[SegmentPlane], Int32[np.ndarray, "sh sw"]]:
    """Planes, and which of them, from 1 on, the pixels of the segments lie on where that is known
    well; 0 for none.

    Of an unsure part at whose own rim most of what is sure lies on no plane nothing is known: a
    segment may go on beyond an edge that is too faint to be seen.
    """
    from geogs.depth.revision import segment_plane_kernels as kernels

    shape = labels.shape
    depth, confidence = (_resized(m, shape) for m in (found.depth, found.confidence))
    is_sky = np.zeros(shape, bool) if sky is None else _resized(sky.view(np.uint8), shape) > 0
    sure, unsure = confidence > SURE, confidence <= UNSURE
    reach = max(1, round(RIM * max(shape)))
    boxes, counts = (np.empty((int(labels.max(initial=0)), k), np.int64) for k in (4, 3))
    kernels.segment_boxes(labels, unsure, is_sky, boxes, counts)
    worth_it = (counts[:, 1] >= _LEAST) & (counts[:, 2] <= SKY * counts[:, 0])
    planes, which = list[SegmentPlane](), np.zeros(shape, np.int32)
    parts, told = np.zeros((2, *shape), np.int32)
    for label in np.flatnonzero(worth_it) + 1:
        top, left, low, right = box = tuple(boxes[label - 1].tolist())
        known = kernels.rim_pixels(labels, label, box, reach, sure)
        some = known[:: -(-len(known) // _MOST) or 1]
        value, weight = (m.ravel()[some].astype(np.float64) for m in (depth, confidence))
        own = list(segment_planes(_places(shape, some), 1 / value, weight, rng))
        if not own:
            continue
        kernels.told_by_rim(
            labels, label, box, reach, unsure, sure, depth, np.stack([p.coefficients for p in own]),
            TOLERANCE, MOSTLY, _LEAST, parts, told,
        )  # fmt: skip
        nearest = _nearest(own, some, shape)[top:low, left:right]
        for number, plane in enumerate(own):
            planes.append(plane)
            kernels.mark_stable(
                told, label, nearest, number, box, plane.coefficients, plane.covariance, STABLE,
                len(planes), which,
            )  # fmt: skip
    return planes, which


def _resized(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Those of the nearest pixels at another size of the same image."""
    if values.shape == shape:
        return values
    return cv2.resize(values, shape[::-1], interpolation=cv2.INTER_NEAREST)


def _places(shape: tuple[int, ...], pixels: Int[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
    """(x, y, 1) of flat indices in an image, x and y over its width and height and from its
    middle."""
    height, width = shape
    v, u = np.divmod(pixels, width)
    return np.stack([(u + 0.5) / width - 0.5, (v + 0.5) / height - 0.5, np.ones(len(pixels))], -1)


def segment_planes(
    places: Float64[np.ndarray, "n 3"],
    value: Float64[np.ndarray, "n"],
    weight: Float64[np.ndarray, "n"],
    rng: np.random.Generator,
) -> Iterator[SegmentPlane]:
    """The planes that explain what is known of a segment, that of most first.

    Args:
        places: of its pixels (x, y, 1).
        value: their inverse depth.
        weight: their confidence.
        rng: draws samples.
    """
    left = np.arange(len(value))
    for _ in range(MOST_PLANES):
        if len(left) < _LEAST:
            return
        fit = _plane(places[left], value[left], weight[left], rng)
        if fit is None or weight[left[fit[2]]].sum() < LEAST_SHARE * weight.sum():
            return
        coefficients, information, is_on = fit
        on = np.zeros(len(value), bool)
        on[left[is_on]] = True
        yield SegmentPlane(coefficients, information, on, float(value[on].mean()))
        left = left[~is_on]


def _plane(
    at: Float64[np.ndarray, "n 3"],
    value: Float64[np.ndarray, "n"],
    weight: Float64[np.ndarray, "n"],
    rng: np.random.Generator,
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3 3"], Bool[np.ndarray, "n"]] | None:
    """The plane that most of the weight lies on, by samples of three, and fitted to that."""
    from geogs.depth.revision.segment_plane_kernels import fit_plane

    plane, information, on = np.empty(3), np.empty((3, 3)), np.empty(len(value), bool)
    uniform = rng.random((_TRIES, 3))
    if fit_plane(at, value, weight, uniform, TOLERANCE, _ROUNDS, _LEAST, on, plane, information):
        return plane, information, on
    return None


def _nearest(
    planes: Sequence[SegmentPlane], known: Int[np.ndarray, "n"], shape: tuple[int, ...]
) -> Int[np.ndarray, "h w"]:
    """On which plane that of the known pixels lies that is nearest to each pixel."""
    if len(planes) < 2:
        return np.zeros(shape, np.int64)
    distances = []
    for plane in planes:
        empty = np.ones(shape, np.uint8)
        empty.ravel()[known[plane.on]] = 0
        distances.append(cv2.distanceTransform(empty, cv2.DIST_L2, 5))
    return np.argmin(distances, 0)
