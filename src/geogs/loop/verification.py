"""Feature-based verification that two keyframes show the same place, with their relative pose."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.world.grid import SampleGrid
from geogs.world.loops import ImageFeatures, TwoViewMatch

MATCH_RATIO = 0.87
"""Largest ratio of the distances to the nearest and second nearest descriptor: looser than Lowe's
0.8, since the pose rejects wrong matches."""
MAX_REPROJECTION = 0.006
"""Largest error of an inlier of a resected pose, as a fraction of the long edge: ORB corners of
coarse scales are less precise than the finest ones."""
MAX_EPIPOLAR = 0.002
"""Largest distance of an inlier from its epipolar line, as a fraction of the long edge: one pixel
of 512."""
MIN_INLIERS = 15
"""Fewest matches that agree with the pose."""
MIN_INLIERS_WITHOUT_DEPTH = 25
"""Fewest where no depth is known, as a match then gives only half the constraints."""
MIN_INLIER_RATIO = 0.3
"""Least fraction of all matches that agree with the pose."""
MIN_SPREAD = 0.25
"""Least fraction of the raster's cells that contain inliers, in the poorer image: one picture that
hangs in two rooms is no loop."""
DEPTH_TOLERANCE = 0.15
"""Relative deviation within which an inlier's depths in both views agree, up to one scale: more
than the error of tracked depth."""
MIN_CONSISTENT = 0.6
"""Least fraction of the inliers with depth in both views whose depths agree."""
MAX_SCALE = 3.0
"""Largest factor between the scales of both views' depths, either way: drift is less."""
RASTER = 4
"""Cells per side of the raster that measures the spread of the inliers."""
ITERATIONS = 300
"""Samples drawn for a pose."""


@dataclass(frozen=True)
class FeatureView:
    """A view's features and their depths."""

    features: ImageFeatures
    depth: Float32[np.ndarray, "n"] | None = None
    """z of each feature; 0 where unknown. None if no depth is known."""

    @staticmethod
    def of(
        grid: SampleGrid,
        inverse_depth: Float[Tensor, "p"],
        information: Float[Tensor, "p"],
        features: ImageFeatures,
    ) -> "FeatureView":
        """Take depths from a keyframe; known where the nearest cell has information."""
        points = torch.from_numpy(features.pixels).to(grid.device)
        inverse = grid.sample_field(inverse_depth[:, None], points)[:, 0]
        cell, inside = grid.cells_of(points)
        known = inside & (information[cell] > 0) & (inverse > 1e-6)
        depth = torch.where(known, 1 / inverse.clamp(min=1e-6), torch.zeros_like(inverse))
        return FeatureView(features, depth.float().cpu().numpy())


class TwoViewVerifier:
    """Matches features and accepts pairs whose matches agree on one pose."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._K = camera.K
        self._edge = camera.long_edge

    def verify(self, first: FeatureView, second: FeatureView) -> TwoViewMatch:
        """Estimate the pose of the second view from matches with the first.

        With depth in the first view by PnP, metric; otherwise by the essential matrix. Depth in
        both must agree at the inliers up to one scale, which is returned.
        """
        pairs = self._match(first.features, second.features)
        if len(pairs) < MIN_INLIERS:
            return TwoViewMatch(False, f"only {len(pairs)} features match", matches=len(pairs))
        seen = first.features.pixels[pairs[:, 0]], second.features.pixels[pairs[:, 1]]
        a, b = (self.camera.as_pinhole(torch.from_numpy(pixels)).numpy() for pixels in seen)
        depth = None if first.depth is None else first.depth[pairs[:, 0]]
        if depth is not None and int((depth > 0).sum()) >= MIN_INLIERS:
            a, b, pairs, depth = (x[depth > 0] for x in (a, b, pairs, depth))
            found = self._resect(a, b, depth)
        else:
            depth = None
            found = self._epipolar(a, b)
        if found is None:
            return TwoViewMatch(False, "the matches agree on no pose", matches=len(pairs))
        T, inlier = found
        view = TwoViewMatch(
            True,
            "",
            torch.from_numpy(T),
            depth is not None,
            matches=len(pairs),
            inliers=int(inlier.sum()),
            spread=min(self._spread(a[inlier]), self._spread(b[inlier])),
        )
        reason = self._weakness(view)
        if not reason and depth is not None and second.depth is not None:
            predicted = self._points(a, depth) @ T[2, :3] + T[2, 3]
            own = second.depth[pairs[:, 1]]
            scale, reason = self._scale(own[inlier], predicted[inlier])
            view = replace(view, scale=scale)
        return replace(view, accepted=not reason, reason=reason)

    def _match(self, first: ImageFeatures, second: ImageFeatures) -> Int64[np.ndarray, "m 2"]:
        """Match mutual nearest descriptors that pass the ratio test."""
        there = _distinct(first.descriptors, second.descriptors)
        # The reverse search is only done for matched targets.
        hit, at = np.unique(there[:, 1], return_inverse=True)
        back = _distinct(second.descriptors[hit], first.descriptors)
        origin = np.full(len(hit), -1)
        origin[back[:, 0]] = back[:, 1]
        return there[origin[at] == there[:, 0]]

    def _points(
        self, pixels: Float32[np.ndarray, "m 2"], depth: Float32[np.ndarray, "m"]
    ) -> Float64[np.ndarray, "m 3"]:
        """Return points in the camera frame."""
        c = self.camera
        z = depth.astype(np.float64)
        x, y = (pixels[:, 0] - c.cx) / c.fx, (pixels[:, 1] - c.cy) / c.fy
        return np.stack([x * z, y * z, z], -1)

    def _resect(
        self,
        a: Float32[np.ndarray, "m 2"],
        b: Float32[np.ndarray, "m 2"],
        depth: Float32[np.ndarray, "m"],
    ) -> tuple[Float64[np.ndarray, "4 4"], Bool[np.ndarray, "m"]] | None:
        """Estimate the pose by RANSAC over three points, refined on its inliers."""
        points = self._points(a, depth)
        image = b.astype(np.float64)
        limit = MAX_REPROJECTION * self._edge
        ok, r, t, chosen = cv2.solvePnPRansac(
            points,
            image,
            self._K,
            None,
            iterationsCount=ITERATIONS,
            reprojectionError=limit,
            flags=cv2.SOLVEPNP_AP3P,
        )
        if not ok or chosen is None or len(chosen) < 6:
            return None
        chosen = chosen[:, 0]
        r, t = cv2.solvePnPRefineLM(points[chosen], image[chosen], self._K, None, r, t)
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(r)[0]
        T[:3, 3] = t[:, 0]
        moved = points @ T[:3, :3].T + T[:3, 3]
        shown = cv2.projectPoints(points, r, t, self._K, None)[0][:, 0]
        inlier = (moved[:, 2] > 0) & (np.linalg.norm(shown - image, axis=1) < limit)
        return (T, inlier) if np.isfinite(T).all() else None

    def _epipolar(
        self, a: Float32[np.ndarray, "m 2"], b: Float32[np.ndarray, "m 2"]
    ) -> tuple[Float64[np.ndarray, "4 4"], Bool[np.ndarray, "m"]] | None:
        """Estimate the pose by MAGSAC over essential matrices; the translation has length one."""
        E, mask = cv2.findEssentialMat(
            a.astype(np.float64),
            b.astype(np.float64),
            self._K,
            method=cv2.USAC_MAGSAC,
            prob=0.999,
            threshold=MAX_EPIPOLAR * self._edge,
        )
        if E is None or E.shape != (3, 3):
            return None
        # Points at any distance count: a revisit may have no parallax at all.
        _, R, t, ahead, _ = cv2.recoverPose(
            E, a.astype(np.float64), b.astype(np.float64), self._K, distanceThresh=1e6, mask=mask
        )
        T = np.eye(4)
        T[:3, :3] = R
        T[:3, 3] = t[:, 0]
        return T, ahead[:, 0] > 0

    def _spread(self, pixels: Float32[np.ndarray, "m 2"]) -> float:
        size = np.array([self.camera.width, self.camera.height])
        cell = np.clip((pixels + 0.5) * RASTER / size, 0, RASTER - 1).astype(int)
        return len(np.unique(cell @ [1, RASTER])) / RASTER**2

    def _weakness(self, view: TwoViewMatch) -> str:
        if view.inliers < (MIN_INLIERS if view.is_metric else MIN_INLIERS_WITHOUT_DEPTH):
            return f"only {view.inliers} matches agree with the pose"
        if view.inlier_ratio < MIN_INLIER_RATIO:
            return f"only {view.inlier_ratio:.0%} of the matches agree with the pose"
        if view.spread < MIN_SPREAD:
            return f"the matches fill only {view.spread:.0%} of the image"
        return ""

    def _scale(
        self, own: Float32[np.ndarray, "m"], predicted: Float64[np.ndarray, "m"]
    ) -> tuple[float | None, str]:
        """Return the median ratio of the second's depth to the first's, and why it is rejected."""
        known = own > 0
        if int(known.sum()) < MIN_INLIERS // 2:
            return None, ""
        ratio = np.log(own[known] / predicted[known])
        middle = float(np.median(ratio))
        if abs(middle) > np.log(MAX_SCALE):
            return None, f"the depths differ by a factor of {np.exp(abs(middle)):.1f}"
        agreeing = float((np.abs(ratio - middle) < DEPTH_TOLERANCE).mean())
        if agreeing < MIN_CONSISTENT:
            return None, f"the depths agree at only {agreeing:.0%} of the matches"
        return float(np.exp(middle)), ""


def _distinct(
    source: UInt8[np.ndarray, "n 32"], target: UInt8[np.ndarray, "m 32"]
) -> Int64[np.ndarray, "d 2"]:
    """Return descriptors and their nearest in the target, where the ratio test passes."""
    from geogs.loop.hamming_kernels import two_nearest

    index, nearest, second = two_nearest(source.view(np.uint64), target.view(np.uint64))
    distinct = np.flatnonzero(nearest < MATCH_RATIO * second)
    return np.stack([distinct, index[distinct]], -1)
