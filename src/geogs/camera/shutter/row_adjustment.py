"""Bundle adjustment of a clip whose rows are seen in turn, together with the readout.

Points that are followed through all images of a clip tell its poses and their depths. A point is
seen at the time of its row, and where it is then, the poses around say: the polynomial through
where they put it at the times of the middle rows. What is measured stays as it is. To move it to
one time instead would smooth its errors, the more the further, and prefer a readout for that.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from geogs.camera.shutter.clip_reconstruction import ClipReconstruction
from geogs.camera.shutter.clip_tracks import ClipTracks
from geogs.geometry.robust import geman_mcclure_cost, geman_mcclure_weight

POWERS = 0, 2, 4
"""Powers of the distance from the axis that scale the shift of a point by a longer focal length,
and by OpenCV's k1 and k2."""
NODES = 5
"""Images whose poses say where a point is between them. Fewer make little of quick tremor and the
readout too long for it: of 27.6 ms, jerks tell 28.2 with five, 27.6 with nine. More make much of
the poses' own errors, which say that nothing is sheared, where the true motion is steady."""
AHEAD = 0.2
"""Depth, in that of the middle image, below which a point that is seen tells nothing: it cannot be
there, and where it is thought to be next to the camera it would outweigh all others."""
DAMPING = 1e-6
"""Fraction that is added to the curvatures of poses and points."""


@dataclass(frozen=True)
class ReadoutEquation:
    """Normal equations of the readout by a clip, its poses and points eliminated.

    The unknowns are the readout in seconds and, where they are not known, the relative change of
    the focal length, k1 and k2.
    """

    curvature: Float[np.ndarray, "s s"]
    """Curvature of the cost in the unknowns, poses and points being what is then best."""
    gradient: Float[np.ndarray, "s"]
    """Slope by which the cost falls."""
    square: float
    """Weighted sum of squared errors of all that was measured."""
    cost: float
    """Geman and McClure's, the mean over all measurements: 0 where they fit, 1 where none does."""
    still: tuple[Float[np.ndarray, "k 6"], Float[np.ndarray, "n 3"]]
    """Steps of poses and points, the readout and the lens being fixed."""
    by_shared: list[tuple[Float[np.ndarray, "k 6"], Float[np.ndarray, "n 3"]]]
    """Derivatives of these steps by each of the unknowns."""

    def stepped(
        self, reconstruction: ClipReconstruction, shared: Float[np.ndarray, "s"]
    ) -> ClipReconstruction:
        """The reconstruction after the steps that follow one of the readout and the lens."""
        poses, points = self.still
        for step, (by_pose, by_point) in zip(shared, self.by_shared, strict=True):
            poses, points = poses + step * by_pose, points + step * by_point
        return reconstruction.stepped(poses, points)


def readout_equation(
    tracks: ClipTracks,
    at: ClipReconstruction,
    shared: Float[np.ndarray, "s"],
    tolerance: float,
    around: int = NODES,
) -> ReadoutEquation:
    """Linearised, what is measured weighted by Geman and McClure's loss.

    Args:
        tracks: what is seen.
        at: poses and points.
        shared: the readout, seconds; then, where they are not known, by which fraction the focal
            length is longer than it is taken to be, k1 and k2.
        tolerance: error at which a measurement counts for a quarter, fraction of the focal length.
        around: images whose poses say where a point is between them.
    """
    count = len(tracks.times)
    nodes = _nodes(count, around)
    readout, *sizes = shared
    blend, slope = (of(tracks, readout, around) for of in (interpolation, interpolation_slope))
    places = at.projected()[nodes]
    pinhole = _blended(blend, places)
    radius = np.linalg.norm(pinhole, axis=-1, keepdims=True)
    shapes = [radius**power * pinhole for power, _ in zip(POWERS, sizes, strict=False)]
    error = tracks.plane - pinhole
    for size, shape in zip(sizes, shapes, strict=True):
        error = error - size * shape
    square = (error**2).sum(axis=-1)
    relative = tracks.seen * square / tolerance**2
    ahead = (at.in_cameras()[..., 2] > AHEAD)[nodes].all(axis=1)
    weight = tracks.seen * ahead * geman_mcclure_weight(relative) / tolerance**2
    root = np.sqrt(weight)
    by_own_pose, by_own_point = at.derivatives()
    by_poses = np.empty((*tracks.seen.shape, 2, around, 6))
    by_point = np.zeros_like(by_own_point)
    for j, node in enumerate(nodes.T):
        part = (root * blend[..., j])[..., None, None]
        np.multiply(part, by_own_pose[node], out=by_poses[..., j, :])
        by_point += part * by_own_point[node]
    other = root[..., None, None] * np.stack([error, _blended(slope, places), *shapes], axis=-1)
    joined = np.concatenate([by_poses.reshape(*tracks.seen.shape, 2, -1), other], axis=-1)
    # The middle pose stays where it is.
    free = np.arange(count) != tracks.middle
    cost = float(geman_mcclure_cost(relative)[tracks.seen].mean())
    return _eliminated(joined, by_point, free, nodes, float((weight * square).sum()), cost)


def _eliminated(
    joined: Float[np.ndarray, "k n 2 w"],
    by_point: Float[np.ndarray, "k n 2 3"],
    free: Bool[np.ndarray, "k"],
    around: Int[np.ndarray, "k j"],
    square: float,
    cost: float,
) -> ReadoutEquation:
    """The equation that is left without points, which each see only their own, and poses.

    Args:
        joined: derivatives of the predictions by the poses of an image's nodes; then errors, and
            derivatives of the predictions by the readout and the lens.
        by_point: by the point.
        free: of all images, whether their pose is free.
        around: the nodes of each image.
        square: of the result.
        cost: of the result.
    """
    count, n = joined.shape[:2]
    each = np.swapaxes(by_point, 0, 1).reshape(n, -1, 3)
    normal = np.swapaxes(each, 1, 2) @ each
    trace = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    normal += (DAMPING / 3 * trace + 1e-9) * np.eye(3)
    root = np.linalg.cholesky(np.linalg.inv(normal))
    # What an image sees concerns the poses around it alone, so each adds to few columns.
    others = joined.shape[-1] - 6 * around.shape[1]
    size = 6 * count + others
    H, by_points = np.zeros((size, size)), np.zeros((n, 3, size))
    for own, point, nodes in zip(joined, by_point @ root, around, strict=True):
        columns = np.r_[6 * nodes[0] : 6 * nodes[-1] + 6, size - others : size]
        flat = own.reshape(2 * n, -1)
        H[columns[:, None], columns] += flat.T @ flat
        by_points[..., columns] += np.swapaxes(point, 1, 2) @ own
    kept = np.append(np.repeat(free, 6), np.ones(others, bool))
    by_points = by_points[..., kept]
    flat = by_points.reshape(3 * n, -1)
    H = H[np.ix_(kept, kept)] - flat.T @ flat
    own = len(H) - others
    diagonal = H.diagonal()[:own]
    poses = H[:own, :own] + np.diag(DAMPING * diagonal + 1e-7 * diagonal.mean())
    following = np.linalg.solve(poses, H[:own, own:])
    steps = []
    for column, step in enumerate(following.T, own):
        left = by_points[..., column] - by_points[..., :own] @ step
        points = (root @ left[..., None])[..., 0]
        all_poses = np.zeros((count, 6))
        all_poses[free] = step.reshape(-1, 6)
        steps.append((all_poses, points))
    left = H[own:, own:] - H[own:, :own] @ following
    by_shared = [(-poses, -points) for poses, points in steps[1:]]
    return ReadoutEquation(left[1:, 1:], left[0, 1:], square, cost, steps[0], by_shared)


def _blended(
    weights: Float[np.ndarray, "k n j"], around: Float[np.ndarray, "k j n 2"]
) -> Float[np.ndarray, "k n 2"]:
    """Sums over the nodes."""
    blended = weights[..., 0, None] * around[:, 0]
    for j in range(1, weights.shape[-1]):
        blended += weights[..., j, None] * around[:, j]
    return blended


def _nodes(count: int, around: int) -> Int[np.ndarray, "k j"]:
    """The images around each, itself among them."""
    first = np.clip(np.arange(count) - around // 2, 0, count - around)
    return first[:, None] + np.arange(around)


def interpolation(
    tracks: ClipTracks, readout: float, around: int = NODES
) -> Float[np.ndarray, "k n j"]:
    """Weights of the nodes in where a point is at the time of its row (Lagrange)."""
    when = tracks.times[:, None] + readout * tracks.line_times
    at = tracks.times[_nodes(len(tracks.times), around)].T[..., None]
    ahead = when - at
    weights = np.ones((*when.shape, around))
    for j in range(around):
        for other in range(around):
            if other != j:
                weights[..., j] *= ahead[other] / (at[j] - at[other])
    return weights


def interpolation_slope(
    tracks: ClipTracks, readout: float, around: int = NODES
) -> Float[np.ndarray, "k n j"]:
    """Derivatives of the weights by the readout, 1 / s."""
    small = 5e-4
    after, before = (interpolation(tracks, readout + by, around) for by in (small, -small))
    return (after - before) / (2 * small)
