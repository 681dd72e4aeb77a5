"""Poses, cameras and points of matched photographs, by pycolmap's incremental mapping."""

import itertools
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from geogs.geometry.umeyama import umeyama
from geogs.threads import worker_count
from geogs_photos.database import SharedCamera, known_cameras
from geogs_photos.pycolmap_library import load_colmap

LEAST_IMAGES = 3
"""Fewest pictures of a part."""
LEAST_POINTS = 15
"""Fewest points of a frame whose pose is accepted."""
FREE_IMAGES = 8
"""Fewest pictures of a camera whose principal point and second radial term are estimated."""
FREE_POINTS = 300
"""Least mean number of points in each of these pictures."""
MAX_OFFSET = 0.08
"""Largest offset of an estimated principal point, as a fraction of the longer side."""
CLOSE = 3.0
"""Limit of the reprojection error, as a multiple of its mean, once that is known. With pycolmap's
usual four pixels people who cross the view agree with poses that are centimetres off; a smaller
multiple rejects too much of the shift by a rolling shutter."""
LEAST_WITHIN = 0.3
"""Least such limit, pixels: features are hardly more accurate."""
POSE_FACTOR = 3.0
"""Multiple of the limit for matches that give a picture its pose before the adjustment."""


def put_together(
    database: Path,
    work: Path,
    count: int,
    known: Sequence[int],
    seed: int,
    progress: Callable[[float], None],
    within: float | None = None,
) -> list[Any]:
    """Reconstructions of the connected parts, the largest first.

    Args:
        database: with verified matches of ``count`` pictures.
        work: folder for pycolmap's files.
        count: number of pictures.
        known: numbers of the fixed cameras.
        seed: of the random choices.
        progress: called with the finished fraction; its exceptions end the work.
        within: limit of the reprojection error, pixels; none is pycolmap's usual.
    """
    options = _options(known, seed, min_model_size=LEAST_IMAGES)
    if within is not None:
        with closing(load_colmap().Database.open(database)) as opened:
            _keep_within(options, within, opened.read_all_cameras())
    work.mkdir(parents=True, exist_ok=True)
    models = load_colmap().incremental_mapping(
        database, work, work, options=options, next_image_callback=_counting(2, count, progress)
    )
    return largest_first(models)


def continued(
    database: Path,
    work: Path,
    known: Mapping[int, Float64[np.ndarray, "4 4"]],
    seed: int,
    progress: Callable[[float], None],
) -> Any | None:
    """Reconstruct pictures of known poses and those that join them; none if the known ones see no
    point.

    The limit of the reprojection error follows from the points of the known poses.

    Args:
        database: with verified matches; its one camera is known.
        work: folder for pycolmap's files.
        known: fixed poses, world to camera, by the numbers of the pictures.
        seed: of the random choices.
        progress: called with the finished fraction; its exceptions end the work.
    """
    colmap = load_colmap()
    options = _options([1], seed, multiple_models=False, fix_existing_frames=True)
    options.mapper.abs_pose_min_num_inliers = LEAST_POINTS
    begun = work / "begun"
    went_on = work / "on"
    model, count = of_poses(database, known)
    for folder in (begun, went_on):
        folder.mkdir(parents=True, exist_ok=True)
    for is_first in (True, False):
        model = colmap.triangulate_points(model, database, work, begun, options=options)
        if not model.num_points3D():
            return None
        if is_first:
            within = CLOSE * model.compute_mean_reprojection_error()
            _keep_within(options, within, model.cameras.values())
    model.write(begun)
    models = colmap.incremental_mapping(
        database,
        work,
        went_on,
        options=options,
        input_path=begun,
        next_image_callback=_counting(len(known), count, progress),
    )
    return next(iter(largest_first(models)), None)


def _options(known: Sequence[int], seed: int, **more: Any) -> Any:
    """pycolmap's options, with fixed cameras."""
    options = load_colmap().IncrementalPipelineOptions(
        num_threads=worker_count(), random_seed=seed, extract_colors=False, **more
    )
    options.constant_cameras = set(known)
    options.mapper.random_seed = options.triangulation.random_seed = seed
    return options


def _keep_within(options: Any, within: float, cameras: Iterable[Any]) -> None:
    """Limit the reprojection errors to ``within`` pixels, and the angles of rays to the same; at
    most pycolmap's usual limit."""
    within = min(max(within, LEAST_WITHIN), options.mapper.filter_max_reproj_error)
    angle = math.degrees(within / min(camera.mean_focal_length() for camera in cameras))
    options.mapper.filter_max_reproj_error = within
    options.mapper.abs_pose_max_error = POSE_FACTOR * within
    points = options.triangulation
    points.complete_max_reproj_error = points.merge_max_reproj_error = within
    points.create_max_angle_error = points.continue_max_angle_error = angle


def _counting(placed: int, count: int, progress: Callable[[float], None]) -> Callable[[], None]:
    """Callback after each picture; ``placed`` of ``count`` pictures had poses before."""
    numbers = itertools.count(placed + 1)
    return lambda: progress(min(next(numbers) / count, 1.0))


def of_poses(database: Path, known: Mapping[int, Float64[np.ndarray, "4 4"]]) -> tuple[Any, int]:
    """Make a reconstruction without points; return it and the number of pictures in the database.

    ``known`` are poses, world to camera, by the numbers of the pictures.
    """
    colmap = load_colmap()
    model = colmap.Reconstruction()
    with closing(colmap.Database.open(database)) as opened:
        for camera in opened.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for image in opened.read_all_images():
            if image.image_id in known:
                pose = colmap.Rigid3d(np.ascontiguousarray(known[image.image_id][:3]))
                model.add_image_with_trivial_frame(image, pose)
        return model, opened.num_images()


def largest_first(models: Mapping[int, Any]) -> list[Any]:
    """Reconstructions with enough pictures to count as a part, the largest first."""
    parts = [model for model in models.values() if model.num_reg_images() >= LEAST_IMAGES]
    return sorted(parts, key=lambda model: -model.num_reg_images())


def placed_images(model: Any) -> list[Any]:
    """Frames of a video with an accepted pose, by name; those with few points are left out."""
    placed = (i for i in model.images.values() if i.has_pose and i.num_points3D >= LEAST_POINTS)
    return sorted(placed, key=lambda image: image.name)


def without_poses(model: Any, numbers: Iterable[int]) -> Any:
    """Remove the poses of the pictures of these numbers."""
    for number in numbers:
        model.deregister_frame(model.images[number].frame_id)
    model.tear_down()  # removes pictures without a pose, with which covariances fail
    return model


def world_to_camera(image: Any) -> Float64[np.ndarray, "4 4"]:
    """The pose of a picture."""
    T = np.eye(4)
    T[:3] = image.cam_from_world().matrix()
    return T


def shifts(one: Any, other: Any, numbers: Sequence[int]) -> Float64[np.ndarray, "n"]:
    """Distances between the pictures' centres in two reconstructions, after the best-fitting
    similarity, in units of the other."""
    before, now = (
        torch.from_numpy(np.stack([m.images[n].projection_center() for n in numbers]))
        for m in (one, other)
    )
    scale, R, t = umeyama(before, now)
    return (scale * before @ R.T + t - now).norm(dim=1).numpy()


def refine(model: Any, cameras: Sequence[SharedCamera]) -> Any:
    """Adjust a reconstruction again, robustly, with more parameters of each camera.

    Unknown cameras with enough pictures get a free principal point and a second radial term, unless
    these diverge; the others keep their model. Pixels are square: two focal lengths, which pictures
    hardly distinguish, did not improve surveyed cameras.
    """
    colmap = load_colmap()
    known = set(known_cameras(cameras))
    free = {number for number in model.cameras if _is_free(model, number) and number not in known}
    trial = colmap.Reconstruction(model)
    for number in free:
        camera = trial.cameras[number]
        if camera.model != colmap.CameraModelId.RADIAL:
            focal, cx, cy, k1 = camera.params
            camera.model = colmap.CameraModelId.RADIAL
            camera.params = [focal, cx, cy, k1, 0.0]
    if free:
        adjust(trial, set(model.cameras) - free)
        if all(_is_central(trial.cameras[number]) for number in free):
            return trial
    adjust(model, known, with_centres=False)
    return model


def _is_free(model: Any, number: int) -> bool:
    seen = [
        image.num_points3D
        for image in model.images.values()
        if image.has_pose and image.camera_id == number
    ]
    return len(seen) >= FREE_IMAGES and sum(seen) >= FREE_POINTS * len(seen)


def _is_central(camera: Any) -> bool:
    offset = max(
        abs(camera.principal_point_x - camera.width / 2),
        abs(camera.principal_point_y - camera.height / 2),
    )
    return offset <= MAX_OFFSET * max(camera.width, camera.height)


def adjust(model: Any, constant: Collection[int], with_centres: bool = True) -> None:
    """Adjust a reconstruction in place, robustly.

    All parameters of the cameras are free, except for those of the ``constant`` ones and, unless
    ``with_centres``, the principal points.
    """
    colmap = load_colmap()
    options = colmap.BundleAdjustmentOptions(
        refine_principal_point=with_centres, print_summary=False
    )
    options.ceres.loss_function_type = colmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.function_tolerance = 1e-6
    options.ceres.solver_options.num_threads = worker_count()
    config = colmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    for number in constant:
        config.set_constant_cam_intrinsics(number)
    config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    colmap.create_default_bundle_adjuster(options, config, model).solve()
