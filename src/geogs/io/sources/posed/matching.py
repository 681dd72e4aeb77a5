"""Pairs of neighbouring images with matched features, found without trusting the poses."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from geogs.geometry.camera import Camera
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.sources.undistort import resized_to

LONG_EDGE = 640
"""Largest long edge for matching, in pixels."""
FEATURES = 800
"""Most features of an image."""
MIN_MATCHES = 25
"""Fewest matches of a usable pair."""
MIN_MOTION = 0.03
"""Least median motion between the images of a pair, relative to the long edge."""
MAX_MOTION = 0.15
"""Median motion beyond which the next pair is searched at a smaller frame distance."""

_RATIO = 0.8
_EPIPOLAR_PIXELS = 1.5
_OFFSETS = (1, 2, 5, 10, 20, 40)


@dataclass(frozen=True, slots=True)
class MatchedPair:
    """Corresponding pixels of images ``first`` and ``second``, in the matcher's ``camera``."""

    first: int
    second: int
    pixels_first: Float64[np.ndarray, "n 2"]
    pixels_second: Float64[np.ndarray, "n 2"]


class Matcher:
    """Finds matched pairs; features of each image are computed once."""

    def __init__(self, source: PosedSource) -> None:
        self._source = source
        camera = source.camera
        is_large = camera.long_edge > LONG_EDGE
        self.camera: Camera = camera.with_long_edge(LONG_EDGE) if is_large else camera
        """Camera of the matched pixels."""
        # Without precise upscaling, features are shifted by a quarter of a pixel right and down.
        self._sift = cv2.SIFT.create(nfeatures=FEATURES, enable_precise_upscale=True)
        self._features: dict[int, tuple[Float64[np.ndarray, "n 2"], np.ndarray]] = {}
        self._offset = 0

    def pairs(self, wanted: int) -> list[MatchedPair]:
        """Up to ``wanted`` pairs, spread over the source."""
        length = len(self._source)
        anchors = np.unique(np.linspace(0, length - 2, min(wanted, length - 1)).astype(int))
        pairs = (self._pair(int(anchor)) for anchor in anchors) if length > 1 else ()
        return [pair for pair in pairs if pair is not None]

    def _pair(self, first: int) -> MatchedPair | None:
        """Find a pair with enough motion: at increasing frame distance, then by least rotation.

        The frame distance is kept, for the next pair will be similar.
        """
        best: MatchedPair | None = None
        for k in range(self._offset, len(_OFFSETS)):
            second = first + _OFFSETS[k]
            if second >= len(self._source):
                second = first - _OFFSETS[k]
            pair = self.match(first, second) if second >= 0 else None
            if pair is None:
                break
            self._offset = k
            best = pair
            motion = self._motion(pair)
            if motion > MAX_MOTION:
                self._offset = max(0, k - 1)
            if motion >= MIN_MOTION:
                return pair
        if best is None:
            turned = (self.match(first, second) for second in self._least_turned(first))
            best = next((pair for pair in turned if pair is not None), None)
            self._offset = max(0, self._offset - 1)
        return best

    def _motion(self, pair: MatchedPair) -> float:
        motion = np.linalg.norm(pair.pixels_first - pair.pixels_second, axis=1)
        return float(np.median(motion)) / self.camera.long_edge

    def _least_turned(self, first: int) -> list[int]:
        """Two images with the least rotation; its angle is right in every axis convention."""
        rotation = self._source.T_cw[:, :3, :3]
        trace = np.einsum("nij,ij->n", rotation, rotation[first])
        trace[first] = -np.inf
        return np.argsort(-trace, kind="stable")[:2].tolist()

    def match(self, first: int, second: int) -> MatchedPair | None:
        """Match two images; none where too few features agree with any epipolar geometry."""
        one, one_descriptors = self._of(first)
        two, two_descriptors = self._of(second)
        if min(len(one), len(two)) < MIN_MATCHES:
            return None
        nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(one_descriptors, two_descriptors, k=2)
        good = [a for a, b in nearest if a.distance < _RATIO * b.distance]
        # Of several matches to one feature only the first is kept.
        _, index = np.unique([match.trainIdx for match in good], return_index=True)
        if len(index) < MIN_MATCHES:
            return None
        one = one[[good[i].queryIdx for i in index]]
        two = two[[good[i].trainIdx for i in index]]
        try:
            inlier = cv2.findFundamentalMat(
                one, two, cv2.USAC_MAGSAC, _EPIPOLAR_PIXELS, 0.999, 2000
            )[1]
        except cv2.error:  # OpenCV 5 fails an assertion where no sample gives a model
            return None
        if inlier is None or inlier.sum() < MIN_MATCHES:
            return None
        keep = inlier.ravel().astype(bool)
        return MatchedPair(first, second, one[keep], two[keep])

    def _of(self, index: int) -> tuple[Float64[np.ndarray, "n 2"], np.ndarray]:
        if index not in self._features:
            view = self._source[index]
            grey = self._scaled(cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY))
            mask = None if view.mask is None else self._scaled(view.mask.astype(np.uint8) * 255)
            points, descriptors = self._sift.detectAndCompute(grey, mask)
            pixels = np.array([point.pt for point in points], dtype=np.float64).reshape(-1, 2)
            if descriptors is None:
                descriptors = np.zeros((0, 128), dtype=np.float32)
            self._features[index] = (pixels, descriptors)
        return self._features[index]

    def _scaled(self, image: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h2 w2"]:
        return resized_to((self.camera.width, self.camera.height), image)
