"""Frames of a video without a place, by structure from motion about others that have one."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from geogs.application.structure_from_motion.photos import FoundFrames
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.threads import thread_map, worker_count
from geogs.types import Frame
from geogs_photos.database import Entry, SharedCamera, match_pairs, write_database
from geogs_photos.deviations import deviations_beside
from geogs_photos.fragments import firmly_joined
from geogs_photos.incremental_mapping import LEAST_POINTS, continued
from geogs_photos.photo_features import find_features
from geogs_photos.photo_pairs import choose_pairs
from geogs_photos.poses import Progress
from geogs_photos.pycolmap_library import load_colmap

NEXT = 6
"""Frames after each that it is matched with in any case."""


def place_lost(
    frames: Sequence[Frame],
    T_cw: Sequence[Float64[np.ndarray, "4 4"] | None],
    camera: Camera,
    seed: int,
    progress: Progress,
) -> FoundFrames:
    """As asked of it in ``geogs.application.structure_from_motion.photos.place_lost``."""
    features = thread_map(
        lambda frame: find_features(frame.image), frames, lambda f: progress("features", f)
    )
    count = len(frames)
    following = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + NEXT, count))}
    alike = choose_pairs(features, seed, lambda f: progress("choosing pairs", f))
    pairs = sorted({*alike, *following})
    calibration = Calibration(
        camera.fx, camera.fy, camera.cx, camera.cy, width=camera.width, height=camera.height
    )
    shared = [SharedCamera(calibration, is_known=True)]
    entries = [Entry(f"{k:06d}", 0, some) for k, some in enumerate(features)]
    known = {k + 1: T for k, T in enumerate(T_cw) if T is not None}
    with tempfile.TemporaryDirectory(prefix="geogs-lost-") as work:
        database, threads = Path(work) / "database.db", worker_count()
        write_database(database, shared, entries)
        match_pairs(database, entries, pairs, seed, threads, lambda f: progress("matching", f))
        model = continued(
            database, Path(work), known, seed, threads, lambda f: progress("finding poses", f)
        )
    if model is not None:
        model = firmly_joined(model, known)
    images = [] if model is None else _found(model, known)
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    for pose, image in zip(poses, images, strict=True):
        pose[:3] = image.cam_from_world().matrix()
    error = float(model.compute_mean_reprojection_error()) if images else 0.0
    deviation, rotation = deviations_beside(model, images, poses, error, known)
    numbers = tuple(frames[image.image_id - 1].index for image in images)
    return FoundFrames(numbers, poses, deviation, rotation)


def _found(model: Any, known: dict[int, Any]) -> list[Any]:
    placed = (i for i in model.images.values() if i.has_pose and i.num_points3D >= LEAST_POINTS)
    return sorted((i for i in placed if i.image_id not in known), key=lambda i: i.image_id)
