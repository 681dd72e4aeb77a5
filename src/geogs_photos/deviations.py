"""Standard deviations of the poses of structure from motion, independent of the gauge."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.linalg import block_diag

from geogs_photos.incremental_mapping import without_poses
from geogs_photos.pycolmap_library import load_colmap

COMMON_ERROR_FACTOR = 2.3
"""Factor on the standard deviations of independent points: a point with an offset has it in most
views. Measured on videos with a truth (docs/notebook/photographs.md)."""
NEAREST = 0.02
"""Fraction of a picture's median depth: nearer points are false, and would outweigh thousands of
others. One in the very centre of a camera, from false matches, makes the covariance impossible."""


def pose_deviations(
    model: Any,
    images: Sequence[Any],
    T_cw: Float64[np.ndarray, "n 4 4"],
    is_known: bool,
    beside: Sequence[Sequence[int]] | None = None,
) -> tuple[Float64[np.ndarray, "n"], Float64[np.ndarray, "n"]]:
    """Standard deviations of the images' centres (world units) and orientations (radians).

    They are those after the best alignment: from the covariance of the adjustment, without its part
    along similarities of the world. Infinite if the covariance cannot be computed. Observations in
    other pictures, and points in front of the lens, are ignored.

    Args:
        model: the reconstruction.
        images: pictures to evaluate.
        T_cw: their poses, world to camera.
        is_known: whether the camera was given, or estimated along with the poses.
        beside: for each image the indices of those that are aligned, which keep their uncertainty:
            open chain ends inherit it. None aligns all.
    """
    colmap = load_colmap()
    model = _evidence(model, images, T_cw)
    error = float(model.compute_mean_reprojection_error())  # deviation of a measured point, pixels
    options = colmap.BundleAdjustmentOptions(
        print_summary=False, refine_principal_point=not is_known
    )
    config = colmap.BundleAdjustmentConfig()
    for image in images:
        config.add_image(image.image_id)
    if is_known:
        for number in model.cameras:
            config.set_constant_cam_intrinsics(number)
    config.fix_gauge(colmap.BundleAdjustmentGauge.THREE_POINTS)
    covariance = _covariance(model, config, options)
    joint = None if covariance is None else _joint(covariance, [i.image_id for i in images])
    if joint is None:
        unknown = np.full(len(images), np.inf)
        return unknown, unknown.copy()
    centre, rotation = without_gauge(joint, T_cw, beside)
    return COMMON_ERROR_FACTOR * error * centre, COMMON_ERROR_FACTOR * error * rotation


def without_gauge(
    joint: Float64[np.ndarray, "k k"],
    T_cw: Float64[np.ndarray, "n 4 4"],
    beside: Sequence[Sequence[int]] | None = None,
) -> tuple[Float64[np.ndarray, "n"], Float64[np.ndarray, "n"]]:
    """Standard deviations of centres and orientations without their part along similarities.

    ``joint`` is the covariance of the poses' left tangents, rotation (3) then translation (3) of
    each. With T = [Exp(w) R, t + dt] the centre -R^T t moves by R^T (w x t - dt), and the axes of
    the camera rotate by R^T w in the world. The similarity of each is that of the images ``beside``
    it, or all.
    """
    count = len(T_cw)
    beside = [range(count)] * count if beside is None else beside
    back = T_cw[:, :3, :3].transpose(0, 2, 1)
    t = T_cw[:, :3, 3]
    eye = np.eye(3)
    moves = block_diag(*np.concatenate([back @ np.cross(t[:, None], eye), -back], 2))
    rotations = block_diag(*np.concatenate([back, 0 * back], 2))
    centres = -np.einsum("nij,nj->ni", back, t)
    centres = centres - centres.mean(0)
    identity = np.tile(eye, (count, 1))
    rotated = np.cross(centres[:, None], eye).reshape(-1, 3)
    similarity = np.concatenate([identity, rotated, centres.reshape(-1, 1)], 1)
    return _left(moves, joint, similarity, beside), _left(rotations, joint, identity, beside)


def _left(
    J: Float64[np.ndarray, "m k"],
    joint: Float64[np.ndarray, "k k"],
    gauge: Float64[np.ndarray, "m g"],
    beside: Sequence[Sequence[int]],
) -> Float64[np.ndarray, "n"]:
    """Standard deviation of each triple of J x after a fit of ``gauge`` to the triples beside."""
    covariance = J @ joint @ J.T
    left = np.zeros(len(beside))
    for k, fitted in enumerate(beside):
        own = slice(3 * k, 3 * k + 3)
        rows = np.add.outer(3 * np.array(fitted, int), range(3)).reshape(-1)
        free = np.zeros((3, len(J)))
        free[:, own] = np.eye(3)
        free[:, rows] -= gauge[own] @ np.linalg.pinv(gauge[rows])
        left[k] = np.sqrt(np.trace(free @ covariance @ free.T).clip(0))
    return left


def _evidence(model: Any, images: Sequence[Any], T_cw: Float64[np.ndarray, "n 4 4"]) -> Any:
    """Copy the reconstruction with these pictures alone, without points nearer than ``NEAREST``."""
    model = load_colmap().Reconstruction(model)
    own = [image.image_id for image in images]
    model = without_poses(model, {*model.reg_image_ids()} - {*own})
    near = set[int]()
    for number, T in zip(own, T_cw, strict=True):
        seen = [p.point3D_id for p in model.images[number].points2D if p.has_point3D()]
        xyz = np.array([model.points3D[point].xyz for point in seen]).reshape(-1, 3)
        depth = xyz @ T[2, :3] + T[2, 3]
        is_near = depth < NEAREST * (np.median(depth) if len(depth) else 0.0)
        near.update(np.array(seen, np.int64)[is_near].tolist())
    for point in near:
        model.delete_point3D(point)
    return model


def _covariance(model: Any, config: Any, options: Any) -> Any | None:
    """pycolmap's covariance of the poses of an adjustment; none if it cannot be computed."""
    colmap = load_colmap()
    adjuster = colmap.create_default_ceres_bundle_adjuster(options, config, model)
    wanted = colmap.BACovarianceOptions(params=colmap.BACovarianceOptionsParams.POSES)
    return colmap.estimate_ba_covariance(wanted, model, adjuster)


def _joint(covariance: Any, numbers: Sequence[int]) -> Float64[np.ndarray, "k k"] | None:
    """The covariance of all poses; none if a pose was fixed, or the covariance overflows."""
    joint = np.zeros((6 * len(numbers), 6 * len(numbers)))
    for a, one in enumerate(numbers):
        for b, other in enumerate(numbers[: a + 1]):
            if a == b:
                block = covariance.get_cam_cov_from_world(one)
            else:
                block = covariance.get_cam_cross_cov_from_world(one, other)
            if block is None or block.shape != (6, 6):
                return None
            joint[6 * a : 6 * a + 6, 6 * b : 6 * b + 6] = block
            joint[6 * b : 6 * b + 6, 6 * a : 6 * a + 6] = block.T
    return joint if np.isfinite(joint).all() else None
