"""Further attempts if incremental mapping of a video gives several parts, or leaves frames out.

If matches contradict a world, the pairs that joined it falsely (sides of a building that look
alike) are removed, and the rest is mapped again. Next is global mapping (rotation averaging, global
positioning, adjustment; Pan et al. 2024), which uses all pairs at once; it takes twice the time of
incremental mapping, and is no better where that finds one whole part. Last, matches are verified
again with the focal length of the largest part, which short parts do not determine, and mapped
incrementally.

The result gives the camera and the residuals of matches that one motion of it explains. With both,
all is mapped again: moving objects have larger residuals, and no longer affect the poses. This
incremental mapping may accept false matches that global mapping did not, so frames have to stay
near their previous positions.
"""

import shutil
from collections.abc import Callable, Container, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from geogs.application.results.verdict import MAX_POSITION_DEVIATION
from geogs.evaluation.trajectory_errors import extent_of
from geogs.threads import worker_count
from geogs_photos.contradictions import false_pairs, undisputed
from geogs_photos.database import SharedCamera, known_cameras
from geogs_photos.deviations import pose_deviations
from geogs_photos.incremental_mapping import (
    CLOSE,
    LEAST_IMAGES,
    LEAST_POINTS,
    largest_first,
    placed_images,
    put_together,
    refine,
    shifts,
    without_poses,
    world_to_camera,
)
from geogs_photos.pycolmap_library import load_colmap

LEAST_VIEWS = 3
"""Least pictures that see a point which propagates the scale between them."""
WHOLE = 0.9
"""Fraction of the frames that one reconstruction has to contain to end the attempts, and of its
frames that the one from close matches has to contain at the same positions."""
SAME_PLACE = 0.15
"""Largest shift of a frame, as a fraction of the path's extent. Moving objects shift frames by a
tenth; a wrong world has arbitrary shifts."""
OUTLIER_RATIO = 3.0
"""Least ratio of an outlier's standard deviation to the median: if all are uncertain, that is left
to the verdict."""


def rejoined(
    parts: Sequence[Any],
    database: Path,
    count: int,
    cameras: Sequence[SharedCamera],
    seed: int,
    progress: Callable[[str, float], None],
) -> list[Any]:
    """Reconstructions by the attempt with most frames in one, from close matches if these agree.

    Args:
        parts: by incremental mapping, the largest first.
        database: with verified matches of ``count`` frames.
        count: number of frames.
        cameras: of the frames.
        seed: of the random choices.
        progress: called with a stage and its finished fraction; its exceptions end the work.
    """
    once_more = partial(progress, "finding poses again")
    known = known_cameras(cameras)
    is_known = len(known) == len(cameras)
    false = false_pairs(parts[0], database) if parts else []
    best = _believed(parts, database, is_known)
    if false and _placed(best) < WHOLE * count:
        again, database = _without(false, database, count, known, seed, once_more)
        best = max(best, _believed(again, database, is_known), key=_placed)
    if _placed(best) < WHOLE * count:
        progress("finding poses globally", 0.0)
        once = _globally(database, is_known, seed)
        best = max(best, _believed(once, database, is_known), key=_placed)
        progress("finding poses globally", 1.0)
    if best and _placed(best) < WHOLE * count and not is_known:
        again = _with_camera_of(best[0], database, count, seed, once_more)
        best = max(best, _believed(again, database, is_known), key=_placed)
    if best:
        first = refine(load_colmap().Reconstruction(best[0]), cameras)
        again = _closely(first, database, count, seed, once_more)
        closer = _believed(again, database, is_known)
        if closer and same_places(first, closer[0]):
            best = closer
    return best


def same_places(one: Any, other: Any) -> bool:
    """Whether ``WHOLE`` of the frames of one reconstruction have the same positions in the other.

    Shifts up to ``SAME_PLACE`` of their extent, after the best similarity, count as the same.
    """
    images = placed_images(one)
    there = {image.image_id for image in placed_images(other)}
    both = [image for image in images if image.image_id in there]
    if len(both) < max(WHOLE * len(images), LEAST_IMAGES):
        return False
    extent = extent_of(np.linalg.inv([world_to_camera(image) for image in both]))
    is_same = shifts(other, one, [image.image_id for image in both]) <= SAME_PLACE * extent
    return bool(is_same.sum() >= WHOLE * len(images))


def believed(model: Any, database: Path, known: Container[int] = ()) -> Any:
    """The part of a reconstruction that is firmly connected and contradicts no matches.

    With ``known`` pictures it is the part connected to these.
    """
    return firmly_joined(undisputed(model, database, known), known)


def firmly_joined(model: Any, known: Container[int] = ()) -> Any:
    """The largest part of a reconstruction with one scale; the other pictures lose their poses.

    With ``known`` pictures it is all that is connected to these.

    Points that a third picture sees, too, propagate the scale between two pictures. If only a few
    such points join two parts, or one picture of a part sees all of them, their relative scale is
    arbitrary: any scale about a single centre fits.
    """
    images = sorted(image.image_id for image in model.images.values() if image.has_pose)
    seen = _firm_points(model, images)
    kept = of_one_scale(seen, np.array([number in known for number in images], bool))
    return without_poses(model, set(images) - {images[k] for k in kept})


def parts_of_one_scale(model: Any, numbers: Sequence[int]) -> list[list[int]]:
    """Indices in ``numbers`` of the pictures of one scale, part by part, the largest first."""
    seen = _firm_points(model, numbers)
    left = np.arange(len(numbers))
    parts = list[list[int]]()
    while len(left):
        kept = left[of_one_scale(seen[:, left], np.zeros(len(left), bool))]
        left = np.setdiff1d(left, kept)
        parts.append(kept.tolist())
    return parts


def _firm_points(model: Any, numbers: Sequence[int]) -> csr_array:
    """1 where one of these pictures (column) sees a point (row) that propagates the scale."""
    place = {number: k for k, number in enumerate(numbers)}
    views = (sorted({e.image_id for e in p.track.elements}) for p in model.points3D.values())
    firm = [seen_by for seen_by in views if len(seen_by) >= LEAST_VIEWS]
    rows = [(k, place[n]) for k, seen_by in enumerate(firm) for n in seen_by if n in place]
    point, image = np.array(rows, np.int64).reshape(-1, 2).T
    return csr_array((np.ones(len(rows), np.int64), (point, image)), (len(firm), len(numbers)))


def of_one_scale(seen: csr_array, known: Bool[np.ndarray, "n"]) -> Int64[np.ndarray, "m"]:
    """Indices of the pictures that are connected, also without any single one of them.

    Args:
        seen: 1 where a point (row) is seen by a picture (column).
        known: the pictures that are connected in any case.
    """
    kept = np.arange(seen.shape[1])
    shared = (seen.T @ seen).toarray()
    shared[np.ix_(known, known)] = LEAST_POINTS
    for without in (-1, *kept):
        rest = kept[kept != without]
        if not len(rest):
            break
        _, part = connected_components(shared[np.ix_(rest, rest)] >= LEAST_POINTS, directed=False)
        if part.any():
            # Enough points may join two parts although no two of their pictures share enough.
            in_part = csr_array((np.ones(len(rest), np.int64), (np.arange(len(rest)), part)))
            by_part = (seen[:, rest] @ in_part > 0).astype(np.int64)
            joined = (by_part.T @ by_part).toarray() >= LEAST_POINTS
            part = connected_components(joined, directed=False)[1][part]
        counted = part[known[rest]] if known[rest].any() else part
        is_kept = part == np.bincount(counted).argmax()
        kept = np.union1d(rest[is_kept], kept[kept == without])
    return kept


def _believed(parts: Sequence[Any], database: Path, is_known: bool) -> list[Any]:
    """The accepted part of each reconstruction; the largest first."""
    found = (with_known_positions(believed(part, database), is_known) for part in parts)
    return sorted(found, key=lambda part: -len(placed_images(part)))


def _placed(parts: Sequence[Any]) -> int:
    return len(placed_images(parts[0])) if parts else 0


def _without(
    pairs: Sequence[tuple[int, int]],
    database: Path,
    count: int,
    known: Sequence[int],
    seed: int,
    progress: Callable[[float], None],
) -> tuple[list[Any], Path]:
    """Parts by incremental mapping without the matches of some pairs, and that database."""
    own = database.with_name("without.db")
    shutil.copy(database, own)
    with closing(load_colmap().Database.open(own)) as opened:
        for one, other in pairs:
            opened.delete_two_view_geometry(one, other)
            opened.delete_matches(one, other)  # or they would be verified once more
    return put_together(own, own.with_name("without"), count, known, seed, progress), own


def _globally(database: Path, is_known: bool, seed: int) -> list[Any]:
    colmap = load_colmap()
    options = colmap.GlobalPipelineOptions(num_threads=worker_count(), random_seed=seed)
    mapper = options.mapper
    mapper.random_seed = seed
    mapper.num_threads = worker_count()
    for stage in (mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        stage.random_seed = seed
    adjustment = mapper.bundle_adjustment
    mapper.global_positioning.use_gpu = adjustment.ceres.use_gpu = False
    adjustment.refine_focal_length = adjustment.refine_extra_params = not is_known
    own = database.with_name("global.db")
    work = database.with_name("global")
    shutil.copy(database, own)
    work.mkdir()
    return largest_first(colmap.global_mapping(own, work, work, options))


def _with_camera_of(
    model: Any, database: Path, count: int, seed: int, progress: Callable[[float], None]
) -> list[Any]:
    colmap = load_colmap()
    own = _with_cameras(model, database, "again.db")
    with closing(colmap.Database.open(own)) as opened:
        opened.clear_two_view_geometries()
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    colmap.geometric_verification(own, two_view_geometry_options=verification)
    known = list(model.cameras)
    return put_together(own, own.with_name("again"), count, known, seed, progress)


def _closely(
    model: Any, database: Path, count: int, seed: int, progress: Callable[[float], None]
) -> list[Any]:
    model.update_point_3d_errors()
    within = CLOSE * model.compute_mean_reprojection_error()
    own = _with_cameras(model, database, "closely.db")
    known = list(model.cameras)
    return put_together(own, own.with_name("closely"), count, known, seed, progress, within)


def _with_cameras(model: Any, database: Path, name: str) -> Path:
    """A copy of the database, with the cameras of a reconstruction."""
    own = database.with_name(name)
    shutil.copy(database, own)
    with closing(load_colmap().Database.open(own)) as opened:
        for camera in model.cameras.values():
            camera.has_prior_focal_length = True
            opened.update_camera(camera)
    return own


def with_known_positions(model: Any, is_known: bool) -> Any:
    """Keep the frames whose positions the matches determine; the others lose their poses.

    A frame that sees little but far points, or the rest of the world in one direction only, can be
    anywhere on a line according to its matches, and thereby enlarges the extent of the path that is
    the measure of its uncertainty. So the worst are removed first, until all have standard
    deviations of at most ``MAX_POSITION_DEVIATION`` of it.

    Args:
        model: by incremental or global mapping.
        is_known: whether the camera was given, or estimated along with the poses.
    """
    while len(images := placed_images(model)) > LEAST_IMAGES:
        T_cw = np.stack([world_to_camera(image) for image in images])
        deviation, _ = pose_deviations(model, images, T_cw, is_known)
        allowed = MAX_POSITION_DEVIATION * extent_of(np.linalg.inv(T_cw))
        unknown = deviation > max(allowed, OUTLIER_RATIO * float(np.median(deviation)))
        if not unknown.any():
            break
        model = without_poses(model, [images[k].image_id for k in np.flatnonzero(unknown)])
    return model
