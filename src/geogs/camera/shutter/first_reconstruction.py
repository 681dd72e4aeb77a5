"""Where the adjustment of a clip begins: two views, then one image after the other."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from geogs.camera.shutter.clip_reconstruction import ClipReconstruction
from geogs.camera.shutter.clip_tracks import LEAST_POINTS, ClipTracks
from geogs.geometry.least_squares import Policy, Step, minimise
from geogs.geometry.robust import geman_mcclure_weight

ROUNDS = 5
"""Gauss-Newton steps to the pose of an image."""
LEAST_FRACTION = 0.5
"""Fraction of the points that both of the two views have to see."""
_FEWEST = 8
"""Points that tell a pose; an image with fewer has that of the image before."""
_PROBABILITY, _TRIES = 0.9999, 1000
"""Confidence with which the motion between two views is found, and tries at most."""


def first_reconstruction(tracks: ClipTracks, tolerance: float) -> ClipReconstruction | None:
    """Poses and points from what is seen, all rows taken to be seen at once.

    Args:
        tracks: of a clip.
        tolerance: error of an inlier between two views, as a fraction of the focal length.

    Returns:
        none where no two views agree on a motion.
    """
    count, n = tracks.seen.shape
    middle = tracks.middle
    enough = np.flatnonzero(tracks.seen.sum(axis=1) >= max(LEAST_POINTS, LEAST_FRACTION * n))
    best, points = 0.0, None
    for far in {int(enough.min()), int(enough.max())} - {middle}:
        both = tracks.seen[far]
        pose = relative_pose(tracks.plane[middle, both], tracks.plane[far, both], tolerance)
        if pose is None:
            continue
        inverse = inverse_depths(*pose, tracks.plane[middle], tracks.plane[far])
        parallax = float(np.median(np.abs(inverse[both])))
        if parallax > best:
            inverse = np.where(both, inverse, np.median(inverse[both])) / parallax
            inverse = np.clip(inverse, -1, 5)
            inverse /= np.median(np.abs(inverse))
            best, points = parallax, np.column_stack([tracks.plane[middle], inverse])
    if points is None:
        return None
    R, t = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    for way in (range(middle + 1, count), range(middle - 1, -1, -1)):
        here = ClipReconstruction(np.eye(3)[None], np.zeros((1, 3)), points)
        for k in way:
            here = _located(here, tracks.plane[k], tracks.seen[k], 3 * tolerance)
            R[k], t[k] = here.R[0], here.t[0]
    return ClipReconstruction(R, t, points)


def relative_pose(
    first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "n 2"], tolerance: float
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]] | None:
    """The motion that most matches agree on (MAGSAC, the same for the same matches).

    A point at X in the first view is at ``R X + t`` in the second; t has the length one.

    Args:
        first: x/z and y/z of the matches in the first view.
        second: in the second view.
        tolerance: error of an inlier, as a fraction of the focal length.
    """
    cv2.setRNGSeed(0)  # process-wide: OpenCV has no generator for one call
    E, inliers = cv2.findEssentialMat(
        first, second, np.eye(3), cv2.USAC_MAGSAC, _PROBABILITY, tolerance, _TRIES
    )
    if E is None or E.shape != (3, 3):
        return None
    _, R, t, _ = cv2.recoverPose(E, first, second, np.eye(3), mask=inliers.copy())
    return R, t[:, 0] / np.linalg.norm(t)


def inverse_depths(
    R: Float[np.ndarray, "3 3"],
    t: Float[np.ndarray, "3"],
    first: Float[np.ndarray, "n 2"],
    second: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, "n"]:
    """Inverse depths in the first view for a translation of the length one (least squares).

    A point at inverse depth d is seen in the second view where ``R (x, y, 1) + d t`` projects.
    """
    turned = np.column_stack([first, np.ones(len(first))]) @ R.T
    still = turned[:, :2] - second * turned[:, 2:]
    moved = t[:2] - second * t[2]
    inverse: Float[np.ndarray, "n"] = -(still * moved).sum(1) / ((moved**2).sum(1) + 1e-12)
    return inverse


def _located(
    near: ClipReconstruction,
    plane: Float[np.ndarray, "n 2"],
    seen: Bool[np.ndarray, "n"],
    tolerance: float,
) -> ClipReconstruction:
    """The pose of one image, from that of a near one; the points stay where they are."""
    if seen.sum() < _FEWEST:
        return near

    def linearised(at: ClipReconstruction) -> tuple[np.ndarray, np.ndarray]:
        error = plane - at.projected()[0]
        by_pose = at.derivatives()[0][0].reshape(-1, 6)
        weight = seen * geman_mcclure_weight((error**2).sum(1) / tolerance**2)
        weighted = np.repeat(weight, 2)[:, None] * by_pose
        return weighted.T @ by_pose, weighted.T @ error.ravel()

    def step(
        at: ClipReconstruction, linear: tuple[np.ndarray, np.ndarray], damping: float
    ) -> Step[ClipReconstruction]:
        normal, right = linear
        raised = normal + (damping * np.trace(normal) + 1e-12) * np.eye(6)
        step = np.linalg.solve(raised, right)
        return Step(at.stepped(step[None], np.zeros_like(at.points)))

    return minimise(near, linearised, step, Policy(ROUNDS, damping=1e-6)).state
