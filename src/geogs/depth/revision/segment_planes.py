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
from geogs.depth.revision.bare_segments import bare_segments
from geogs.geometry.camera import Camera

RIM = 0.0125
"""Long edges of the image around a segment that say where it lies."""
SURE = 0.5
"""Confidence from which a pixel says so, and below which it takes the plane's depth."""
TOLERANCE = 0.02
"""Relative distance in inverse depth from a plane within which a pixel lies on it."""
MOST_PLANES, LEAST_SHARE = 3, 0.35
"""Planes of a segment, as of a wall around a corner, and the part of what is known (by confidence)
that each explains at least."""
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
_LEAST, _MOST, _TRIES, _ROUNDS = 40, 1500, 64, 4
"""Pixels that a fit needs and takes, triples of them that are tried, and fits of the inliers."""


def planar_depth(
    image: UInt8[np.ndarray, "ih iw 3"], found: DenseDepth, camera: Camera, seed: int
) -> DenseDepth:
    """A keyframe's depth, what it is unsure of in bare segments of the image being on their planes.

    ``camera`` is the depth's; ``seed`` draws the samples that are tried.
    """
    device = found.depth.device
    sky = None if found.sky is None else found.sky.cpu().numpy()
    planar = on_planes(found.arrays(), bare_segments(image), sky, seed)
    if not planar.taken.any():
        return found
    taken = torch.from_numpy(planar.taken).to(device)
    normal = found.normal
    if normal is not None:
        facing = torch.from_numpy(planar.normals(camera)).to(device)
        normal = torch.where(taken[..., None], facing, normal)
    return replace(
        found,
        depth=torch.where(taken, torch.from_numpy(planar.depth).to(device), found.depth),
        confidence=torch.where(taken, CONFIDENCE, found.confidence),
        normal=normal,
    )


@dataclass(frozen=True)
class PlanarDepth:
    """Depth on the planes of segments."""

    depth: Float32[np.ndarray, "h w"]
    """z; as it was found where nothing is taken."""
    slopes: Float64[np.ndarray, "h w 2"]
    """Change of inverse depth per pixel to the right and down."""
    taken: Bool[np.ndarray, "h w"]
    """Where the plane is known well, and the depth that was found is not."""

    def normals(self, camera: Camera) -> Float32[np.ndarray, "h w 3"]:
        """Unit normals, camera frame and facing it, where depth is taken.

        With 1 / z = a u + b v + c a point X of the plane has n X = 1 for
        n = (a fx, b fy, a cx + b cy + c).
        """
        v, u = np.mgrid[: camera.height, : camera.width]
        a, b = self.slopes[..., 0], self.slopes[..., 1]
        c = 1 / self.depth - a * u - b * v
        n = np.stack([a * camera.fx, b * camera.fy, a * camera.cx + b * camera.cy + c], -1)
        return (-n / np.linalg.norm(n, axis=-1, keepdims=True)).astype(np.float32)


@dataclass(frozen=True)
class SegmentPlane:
    """Inverse depth as a linear function of the place in the image, and what it was fitted to."""

    coefficients: Float64[np.ndarray, "3"]
    """Of x and y over the image's width and height, and of 1."""
    information: Float64[np.ndarray, "3 3"]
    """Sum of the weighted products of (x, y, 1)."""
    pixels: Int[np.ndarray, "k"]
    """Flat indices of those that lie on it."""
    typical: float
    """Their mean inverse depth."""

    def at(self, places: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n"]:
        """Inverse depth at some places."""
        return places @ self.coefficients

    def deviation(self, places: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n"]:
        """Relative deviation of that: as the fit carries on half the tolerance of its pixels."""
        inverse = np.linalg.inv(self.information + 1e-9 * np.eye(3))
        variance = ALIKE * ((places @ inverse) * places).sum(-1)
        own = np.maximum(self.at(places), 1e-9)
        return np.sqrt(variance) * TOLERANCE / 2 * self.typical / own


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
    planes, which = _planes_of_segments(found, labels, sky, np.random.default_rng(seed))
    depth, slopes = found.depth.copy(), np.zeros((*found.depth.shape, 2))
    which = _resized(which, found.depth.shape)
    (pixels,) = np.nonzero(((which > 0) & (found.confidence <= SURE)).ravel())
    if len(pixels):
        plane = np.stack([p.coefficients for p in planes])[which.ravel()[pixels] - 1]
        value = (plane * _places(found.depth.shape, pixels)).sum(-1)
        own = 1 / found.depth.ravel()[pixels]
        good = (value > own / FARTHEST) & (value < FARTHEST * own)
        pixels = pixels[good]
        depth.ravel()[pixels] = 1 / value[good]
        slopes.reshape(-1, 2)[pixels] = plane[good, :2] / found.depth.shape[::-1]
    taken = np.zeros(found.depth.shape, bool)
    taken.ravel()[pixels] = True
    return PlanarDepth(depth, slopes, taken)


def _planes_of_segments(
    found: KeyframeDepth,
    labels: Int32[np.ndarray, "sh sw"],
    sky: Bool[np.ndarray, "h w"] | None,
    rng: np.random.Generator,
) -> tuple[list[SegmentPlane], Int32[np.ndarray, "sh sw"]]:
    """Planes, and which of them, from 1 on, the pixels of the segments lie on where that is known
    well; 0 for none."""
    depth, confidence = (_resized(m, labels.shape) for m in (found.depth, found.confidence))
    sky = None if sky is None else _resized(sky.astype(np.uint8), labels.shape)
    places = _places(labels.shape, np.arange(labels.size))
    inverse, sure = 1 / depth.astype(np.float64), confidence > SURE
    rim = np.ones((2 * max(1, round(RIM * max(labels.shape))) + 1,) * 2, np.uint8)
    planes, which = list[SegmentPlane](), np.zeros(labels.shape, np.int32)
    for label in range(1, int(labels.max(initial=0)) + 1):
        segment = labels == label
        if sky is not None and sky[segment].mean() > SKY:
            continue
        known = (cv2.dilate(segment.astype(np.uint8), rim) > 0) & sure
        own = list(segment_planes(places, inverse.ravel(), confidence.ravel(), known.ravel(), rng))
        for plane, mine in zip(own, _nearest(own, segment), strict=True):
            planes.append(plane)
            pixels = np.flatnonzero(mine)
            stable = plane.deviation(places[pixels]) < STABLE
            which.ravel()[pixels[stable]] = len(planes)
    return planes, which


def _resized(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Those of the nearest pixels at another size of the same image."""
    if values.shape == shape:
        return values
    return cv2.resize(values, shape[::-1], interpolation=cv2.INTER_NEAREST)


def _places(shape: tuple[int, ...], pixels: Int[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
    """(x, y, 1) of flat indices, over the image's width and height."""
    y, x = np.divmod(pixels, shape[1])
    return np.stack([(x + 0.5) / shape[1] - 0.5, (y + 0.5) / shape[0] - 0.5, np.ones(len(x))], -1)


def segment_planes(
    places: Float64[np.ndarray, "n 3"],
    inverse: Float64[np.ndarray, "n"],
    confidence: Float32[np.ndarray, "n"],
    known: Bool[np.ndarray, "n"],
    rng: np.random.Generator,
) -> Iterator[SegmentPlane]:
    """The planes that explain what is known of a segment, that of most first.

    Args:
        places: of the pixels (x, y, 1).
        inverse: their inverse depth.
        confidence: their weights.
        known: those that count.
        rng: draws samples.
    """
    pixels = np.flatnonzero(known)
    if len(pixels) > _MOST:
        pixels = np.sort(rng.choice(pixels, _MOST, replace=False))
    total = float(confidence[pixels].sum())
    for _ in range(MOST_PLANES):
        if len(pixels) < _LEAST:
            return
        at, value = places[pixels], inverse[pixels]
        weight = confidence[pixels].astype(np.float64)
        fit = _plane(at, value, weight, rng)
        if fit is None or weight[fit[2]].sum() < LEAST_SHARE * total:
            return
        coefficients, information, on = fit
        yield SegmentPlane(coefficients, information, pixels[on], float(value[on].mean()))
        pixels = pixels[~on]


def _plane(
    at: Float64[np.ndarray, "n 3"],
    value: Float64[np.ndarray, "n"],
    weight: Float64[np.ndarray, "n"],
    rng: np.random.Generator,
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3 3"], Bool[np.ndarray, "n"]] | None:
    """The plane that most of the weight lies on, by samples of three, and fitted to that."""
    drawn = rng.choice(len(value), (_TRIES, 3), p=weight / weight.sum())
    drawn = drawn[np.abs(np.linalg.det(at[drawn])) > 1e-9]
    if not len(drawn):
        return None
    tried = np.linalg.solve(at[drawn], value[drawn][..., None])[..., 0]
    on = np.abs(at @ tried.T - value[:, None]) < TOLERANCE * value[:, None]
    on = on[:, np.argmax(weight @ on)]
    for _ in range(_ROUNDS):
        if on.sum() < _LEAST:
            return None
        weighted = at[on] * weight[on, None]
        information = weighted.T @ at[on]
        plane = np.linalg.solve(information + 1e-12 * np.eye(3), weighted.T @ value[on])
        on = np.abs(at @ plane - value) < TOLERANCE * value
    return plane, information, on


def _nearest(
    planes: Sequence[SegmentPlane], segment: Bool[np.ndarray, "h w"]
) -> list[Bool[np.ndarray, "h w"]]:
    """Which of a segment's pixels are nearest to what lies on each plane."""
    if len(planes) < 2:
        return [segment] * len(planes)
    distances = []
    for plane in planes:
        empty = np.ones(segment.shape, np.uint8)
        empty.ravel()[plane.pixels] = 0
        distances.append(cv2.distanceTransform(empty, cv2.DIST_L2, 5))
    nearest = np.argmin(distances, 0)
    return [segment & (nearest == number) for number in range(len(planes))]
