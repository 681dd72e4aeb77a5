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
    coefficients: Float64[np.ndarray, "n 3"]
    """Of inverse depth in x and y over the image's width and height, from its middle, and 1."""

    def normals(self, camera: Camera) -> Float32[np.ndarray, "n 3"]:
        """Unit normals, camera frame and facing it.

        With 1 / z = a u + b v + c a point X of the plane has n X = 1 for
        n = (a fx, b fy, a cx + b cy + c).
        """
        a, b = self.coefficients[:, 0] / camera.width, self.coefficients[:, 1] / camera.height
        v, u = np.divmod(self.pixels, camera.width)
        c = 1 / self.depth - a * u - b * v
        n = np.stack([a * camera.fx, b * camera.fy, a * camera.cx + b * camera.cy + c], -1)
        return (-n / np.linalg.norm(n, axis=-1, keepdims=True)).astype(np.float32)


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

    def at(self, places: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n"]:
        """Inverse depth at some places."""
        return (places * self.coefficients).sum(-1)

    def holds(
        self, places: Float64[np.ndarray, "n 3"], value: Float64[np.ndarray, "n"]
    ) -> Bool[np.ndarray, "n"]:
        """Where an inverse depth lies on it."""
        return np.abs(self.at(places) - value) < TOLERANCE * value

    def deviation(self, places: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n"]:
        """Relative deviation of that: as the fit carries on half the tolerance of its pixels."""
        inverse = np.linalg.inv(self.information + 1e-9 * np.eye(3))
        variance = ALIKE * _quadratic(places, inverse)
        own = np.maximum(self.at(places), 1e-9)
        return np.sqrt(variance) * TOLERANCE / 2 * self.typical / own


def _quadratic(
    places: Float64[np.ndarray, "n 3"], form: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "n"]:
    """Values of a symmetric form at (x, y, 1): written out, as a library's threads cost more."""
    x, y = places[:, 0], places[:, 1]
    mixed = form[0, 1] * x * y + form[0, 2] * x + form[1, 2] * y
    return form[0, 0] * x * x + form[1, 1] * y * y + form[2, 2] + 2 * mixed


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
    shape = found.depth.shape
    planes, which = _planes_of_segments(found, labels, sky, np.random.default_rng(seed))
    which = _resized(which, shape).ravel()
    pixels = np.flatnonzero((which > 0) & (found.confidence.ravel() <= UNSURE))
    coefficients = np.array([p.coefficients for p in planes]).reshape(-1, 3)[which[pixels] - 1]
    value = (coefficients * _places(shape, pixels)).sum(-1)
    own = 1 / found.depth.ravel()[pixels]
    good = (value > own / FARTHEST) & (value < FARTHEST * own)
    return PlanarDepth(pixels[good], (1 / value[good]).astype(np.float32), coefficients[good])


def _planes_of_segments(
    found: KeyframeDepth,
    labels: Int32[np.ndarray, "sh sw"],
    sky: Bool[np.ndarray, "h w"] | None,
    rng: np.random.Generator,
) -> tuple[list[SegmentPlane], Int32[np.ndarray, "sh sw"]]:
    """Planes, and which of them, from 1 on, the pixels of the segments lie on where that is known
    well; 0 for none."""
    shape = labels.shape
    depth, confidence = (_resized(m, shape) for m in (found.depth, found.confidence))
    sky = None if sky is None else _resized(sky.astype(np.uint8), shape)
    reach = max(1, round(RIM * max(shape)))
    rim = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    planes, which = list[SegmentPlane](), np.zeros(shape, np.int32)
    for label in range(1, int(labels.max(initial=0)) + 1):
        around = _box(labels == label, reach)
        segment, sure = labels[around] == label, confidence[around]
        is_sky = sky is not None and sky[around][segment].mean() > SKY
        if is_sky or np.count_nonzero(segment & (sure <= UNSURE)) < _LEAST:
            continue
        known = np.flatnonzero((cv2.dilate(segment.astype(np.uint8), rim) > 0) & (sure > SURE))
        places = _places(shape, known, around)
        value = 1 / depth[around].ravel()[known].astype(np.float64)
        some = slice(None, None, -(-len(known) // _MOST) or 1)
        weight = sure.ravel()[known[some]].astype(np.float64)
        own = list(segment_planes(places[some], value[some], weight, rng))
        if not own:
            continue
        is_on = np.zeros(segment.shape, bool)
        is_on.ravel()[known] = np.any([plane.holds(places, value) for plane in own], 0)
        unsure = _told_by_rim(segment & (sure <= UNSURE), sure > SURE, is_on, rim)
        for plane, mine in zip(own, _nearest(own, known[some], unsure), strict=True):
            planes.append(plane)
            pixels = np.flatnonzero(mine)
            stable = plane.deviation(_places(shape, pixels, around)) < STABLE
            v, u = np.divmod(pixels[stable], segment.shape[1])
            which[v + around[0].start, u + around[1].start] = len(planes)
    return planes, which


def _told_by_rim(
    unsure: Bool[np.ndarray, "h w"],
    sure: Bool[np.ndarray, "h w"],
    is_on: Bool[np.ndarray, "h w"],
    rim: UInt8[np.ndarray, "k k"],
) -> Bool[np.ndarray, "h w"]:
    """The connected unsure parts at whose own rim most of what is sure lies on a plane.

    A segment may go on beyond an edge that is too faint to be seen, and what is unsure there is on
    none of its planes.
    """
    count, parts, stats, _ = cv2.connectedComponentsWithStats(unsure.astype(np.uint8))
    told = np.zeros(unsure.shape, bool)
    for number in range(1, count):
        if stats[number, cv2.CC_STAT_AREA] < _LEAST:
            continue
        part = parts == number
        around = (cv2.dilate(part.astype(np.uint8), rim) > 0) & sure
        if np.count_nonzero(around & is_on) >= MOSTLY * max(1, int(np.count_nonzero(around))):
            told |= part
    return told


def _box(segment: Bool[np.ndarray, "h w"], reach: int) -> tuple[slice, slice]:
    """Rows and columns around a segment, widened."""
    x, y, width, height = cv2.boundingRect(segment.astype(np.uint8))
    rows = slice(max(0, y - reach), min(segment.shape[0], y + height + reach))
    return rows, slice(max(0, x - reach), min(segment.shape[1], x + width + reach))


def _resized(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Those of the nearest pixels at another size of the same image."""
    if values.shape == shape:
        return values
    return cv2.resize(values, shape[::-1], interpolation=cv2.INTER_NEAREST)


def _places(
    shape: tuple[int, ...], pixels: Int[np.ndarray, "n"], box: tuple[slice, slice] | None = None
) -> Float64[np.ndarray, "n 3"]:
    """(x, y, 1) of flat indices in an image or a box of it, x and y over the image's width and
    height and from its middle."""
    height, width = shape
    rows, columns = box or (slice(0, height), slice(0, width))
    v, u = np.divmod(pixels, columns.stop - columns.start)
    places = np.ones((len(pixels), 3))
    places[:, 0] = (u + (columns.start + 0.5)) / width - 0.5
    places[:, 1] = (v + (rows.start + 0.5)) / height - 0.5
    return places


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
    drawn = rng.choice(len(value), (_TRIES, 3), p=weight / weight.sum())
    drawn = drawn[np.abs(np.linalg.det(at[drawn])) > 1e-9]
    if not len(drawn):
        return None
    tried = np.linalg.solve(at[drawn], value[drawn][..., None])
    on = _most(tried[..., 0], at, value, weight)
    for _ in range(_ROUNDS):
        if np.count_nonzero(on) < _LEAST:
            return None
        weighted = at[on] * weight[on, None]
        information = np.einsum("ni,nj->ij", weighted, at[on])
        target = (weighted * value[on, None]).sum(0)
        plane = np.linalg.solve(information + 1e-12 * np.eye(3), target)
        on = np.abs((at * plane).sum(1) - value) < TOLERANCE * value
    return plane, information, on


def _most(
    tried: Float64[np.ndarray, "t 3"],
    at: Float64[np.ndarray, "n 3"],
    value: Float64[np.ndarray, "n"],
    weight: Float64[np.ndarray, "n"],
) -> Bool[np.ndarray, "n"]:
    """What lies on that of the planes on which most of the weight lies.

    Within two arrays, as a new one for each step took twice the time.
    """
    off, part = (np.multiply.outer(tried[:, k], at[:, k]) for k in (0, 1))
    off += part
    off += np.subtract.outer(tried[:, 2], value, out=part)
    on = np.abs(off, out=off) < TOLERANCE * value
    return on[np.argmax(np.multiply(on, weight, out=part).sum(1))]


def _nearest(
    planes: Sequence[SegmentPlane], known: Int[np.ndarray, "n"], unsure: Bool[np.ndarray, "h w"]
) -> list[Bool[np.ndarray, "h w"]]:
    """Which of the unsure pixels are nearest to those of the known ones that lie on each plane."""
    if len(planes) < 2:
        return [unsure] * len(planes)
    distances = []
    for plane in planes:
        empty = np.ones(unsure.shape, np.uint8)
        empty.ravel()[known[plane.on]] = 0
        distances.append(cv2.distanceTransform(empty, cv2.DIST_L2, 5))
    nearest = np.argmin(distances, 0)
    return [unsure & (nearest == number) for number in range(len(planes))]
