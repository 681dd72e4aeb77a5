"""Points followed through a few neighbouring images, as rays with the time of their row."""

import itertools
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from geogs.camera.shutter.neighbours import Image
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.threads import thread_map

MOST_POINTS = 160
LEAST_POINTS = 30
LEAST_IMAGES = 8
"""Images that a point is followed through."""
LEAST_SEEN = 24
"""Points of an image that counts."""
LONGEST_INTERVAL = 0.26
"""Seconds between two images; over more, nothing says how points move from one to the next."""
POINTS, QUALITY, SPACING = 250, 0.005, 8
"""Corners, at most; the least strength of one against the strongest; pixels between two."""
WINDOW, LEVELS = 15, 3
"""Pixels that are compared around a point; halvings at which it is looked for first."""
RETURN = 0.3
"""Pixels by which a point may miss its place on the way back."""
NEAR, AROUND, CONTRAST, FAINT = 27, 83, 40.0, 4.0
"""Sides of the squares over which the mean of the grey values is taken, and their contrast; what
that becomes, and grey levels below which it is not raised as much."""
_STEPS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.003)
_Images = Sequence[UInt8[np.ndarray, "h w"]]


@dataclass(frozen=True)
class ClipTracks:
    """Where points are seen in the images of a clip, and when."""

    plane: Float[np.ndarray, "k n 2"]
    """x/z and y/z; 0 where a point is not seen."""
    line_times: Float[np.ndarray, "k n"]
    """Readouts from the middle row of the image to that of the point; 0 likewise."""
    seen: Bool[np.ndarray, "k n"]
    """Every point in the middle image."""
    times: Float[np.ndarray, "k"]
    """Seconds of the middle rows, from that of the middle image."""

    @property
    def middle(self) -> int:
        """Position of the image that all points are seen in."""
        return int(np.abs(self.times).argmin())


@dataclass(frozen=True)
class FollowedClip:
    """Where points are in the images of a clip, whatever camera took them."""

    pixels: Float[np.ndarray, "k n 2"]
    """nan where a point is not seen."""
    times: Float[np.ndarray, "k"]
    """Seconds of the middle rows, from that of the middle image."""

    def through(self, camera: RollingCamera) -> ClipTracks:
        """The points as rays of the camera that took the images."""
        seen = np.isfinite(self.pixels[..., 0])
        plane, line_times = np.zeros_like(self.pixels), np.zeros(seen.shape)
        rays = camera.rays(self.pixels[seen])
        plane[seen] = rays[:, :2] / rays[:, 2:]
        line_times[seen] = camera.line_times(self.pixels[seen])
        return ClipTracks(plane, line_times, seen, self.times)


def followed_clip(clip: Sequence[Image]) -> FollowedClip | None:
    """Corners of the middle image, those that are seen longest.

    None where they are too few, or the images are too few, too far apart, or could not all be read.
    """
    intervals = np.diff([image.timestamp for image in clip])
    if len(clip) < LEAST_IMAGES or (intervals <= 0).any() or (intervals > LONGEST_INTERVAL).any():
        return None
    images = [cv2.cvtColor(i.image, cv2.COLOR_RGB2GRAY) for i in clip if i.image is not None]
    if len(images) < len(clip):
        return None
    pixels = followed_points(images)
    count = np.isfinite(pixels[..., 0]).sum(axis=0)
    longest = np.sort(np.argsort(-count, kind="stable")[:MOST_POINTS])
    pixels = pixels[:, longest[count[longest] >= LEAST_IMAGES]]
    if pixels.shape[1] < LEAST_POINTS:
        return None
    # Where a fast turn leaves few of them, they do not tell a pose.
    enough = np.isfinite(pixels[..., 0]).sum(axis=1) >= LEAST_SEEN
    if enough.sum() < LEAST_IMAGES:
        return None
    times = np.array([image.timestamp for image in clip])
    return FollowedClip(pixels[enough], times[enough] - clip[len(clip) // 2].timestamp)


class FollowedClips:
    """Clips of a video, followed when somebody asks for them, and no more than once."""

    def __init__(self, read: Callable[[int], Generator[Sequence[Image], None, None]]) -> None:
        """``read`` gives the clips from a number on."""
        self.read = read
        self._known: list[FollowedClip | None] = []

    def up_to(
        self, counts: Sequence[int], report: Callable[[float], None]
    ) -> Generator[list[FollowedClip], None, None]:
        """Clips up to the first of ``counts``, from there to the second, and so on until there are
        no more; of each group those that tell something. Several are followed at a time, and
        ``report`` gets how many there are by then, as a part of the last count."""
        given = 0
        with closing(self.read(len(self._known))) as unread:
            for count in counts:
                known = len(self._known)
                new = list(itertools.islice(unread, max(count - known, 0)))

                def done(fraction: float, known: int = known, new: int = len(new)) -> None:
                    report(min(1.0, (known + fraction * new) / counts[-1]))

                self._known += thread_map(followed_clip, new, done)
                group = self._known[given:count]
                if not group:
                    return
                given += len(group)
                yield [clip for clip in group if clip is not None]


def followed_points(images: _Images) -> Float[np.ndarray, "k n 2"]:
    """Where corners of the middle image are in every image, in pixels; nan where they are lost.

    Each image is compared with the middle one itself, so that nothing adds up on the way (Lucas and
    Kanade's method; Bouguet's pyramid finds the place from image to image first). A window that
    shears or grows moves by what its gradients say, hence as the point amid its gradients does:
    that is the point whose places are returned. The corner itself would be off in one direction all
    over a floor, by a tenth of a pixel and more.
    """
    middle, evened = len(images) // 2, [even(image) for image in images]
    corners = cv2.goodFeaturesToTrack(evened[middle], POINTS, QUALITY, SPACING)
    if corners is None:
        return np.zeros((len(images), 0, 2))
    corners = corners[_inside(corners[:, 0], images[middle])]
    to_centre = _amid_gradients(evened[middle], corners[:, 0])
    places = np.full((len(images), len(corners), 2), np.nan)
    places[middle] = corners[:, 0] + to_centre
    for way in (range(middle, len(images)), range(middle, -1, -1)):
        for k, seen in zip(way[1:], _followed(images, evened, corners, way), strict=True):
            places[k] = seen + to_centre
    return places


def _followed(
    images: _Images, evened: _Images, corners: Float32[np.ndarray, "n 1 2"], way: Sequence[int]
) -> Iterable[Float[np.ndarray, "n 2"]]:
    """Places of the corners of the first image of a way in all others.

    From image to image they are looked for in the images as they are, whose coarse shapes tell how
    far they move; where they are, the ``evened`` ones say.
    """
    window, start = (WINDOW, WINDOW), cv2.OPTFLOW_USE_INITIAL_FLOW
    first, here, motion = evened[way[0]], corners, np.zeros_like(corners)
    left = np.arange(len(corners))  # those that are not lost yet
    for before, after in itertools.pairwise(way):
        places = np.full((len(corners), 2), np.nan)
        if len(left):
            from_first = corners[left]
            there, _, _ = cv2.calcOpticalFlowPyrLK(
                images[before], images[after], here, here + motion, None, None, window, LEVELS,
                _STEPS, start,
            )  # fmt: skip
            there, found, _ = cv2.calcOpticalFlowPyrLK(
                first, evened[after], from_first, there, None, None, window, 0, _STEPS, start
            )
            back, returned, _ = cv2.calcOpticalFlowPyrLK(
                evened[after], first, there, from_first.copy(), None, None, window, 0, _STEPS, start
            )
            missed = np.linalg.norm((back - from_first)[:, 0], axis=1) > RETURN
            kept = (found[:, 0] != 0) & (returned[:, 0] != 0) & ~missed
            kept &= _inside(there[:, 0], images[after])
            left, motion, here = left[kept], (there - here)[kept], there[kept]
            places[left] = here[:, 0]
        yield places


def even(image: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """The image with the same mean and contrast all over.

    Light that falls off towards the corners, or changes, moves a point towards the brighter side of
    its window: of a camera that turns, all of them with the way that they went, as rows do.
    """
    grey = image.astype(np.float32)
    left = grey - cv2.blur(grey, (NEAR, NEAR))
    # Of sums that run along a row, what is left of a bare part may be a little below 0.
    contrast = np.sqrt(np.maximum(cv2.blur(left * left, (AROUND, AROUND)), 0))
    evened = 128.5 + CONTRAST * left / (contrast + FAINT)
    return np.clip(evened, 0, 255).astype(np.uint8)


def _inside(
    pixels: Float[np.ndarray, "n 2"], image: UInt8[np.ndarray, "h w"]
) -> Bool[np.ndarray, "n"]:
    """Whether the window around a point lies within the image."""
    border, size = WINDOW // 2 + 2, np.array(image.shape[::-1])
    return np.all((pixels >= border) & (pixels <= size - 1 - border), axis=1)


def _amid_gradients(
    image: UInt8[np.ndarray, "h w"], pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Vectors from windows' middles to the means of their pixels, weighted by squared gradient."""
    across, down = (cv2.Sobel(image, cv2.CV_32F, *by) for by in ((1, 0), (0, 1)))
    weight = across**2 + down**2
    v, u = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    total, in_u, in_v = (
        cv2.boxFilter(x, -1, (WINDOW, WINDOW), normalize=False)
        for x in (weight, weight * u, weight * v)
    )
    column, row = np.rint(pixels).astype(int).T
    most = np.maximum(total[row, column], 1e-6)
    return np.stack([in_u[row, column] / most - column, in_v[row, column] / most - row], axis=1)
