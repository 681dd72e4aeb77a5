"""Poses of lost frames of a video, by structure from motion around frames with a pose."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from geogs.application.structure_from_motion.completion import about
from geogs.io.sources.calibration import Calibration
from geogs.stopwatch import StageProgress
from geogs.types import FoundFrames, Frame
from geogs_photos.database import Entry, SharedCamera, write_database
from geogs_photos.deviations import pose_deviations
from geogs_photos.fragments import believed, parts_of_one_scale
from geogs_photos.incremental_mapping import continued, placed_images, world_to_camera
from geogs_photos.photo_features import frame_features
from geogs_photos.photo_pairs import frame_pairs
from geogs_photos.poses import FEWEST_FEATURES


def place_lost(
    frames: Sequence[Frame],
    T_cw: Sequence[Float64[np.ndarray, "4 4"] | None],
    seen_by: Calibration,
    seed: int,
    progress: StageProgress,
) -> FoundFrames:
    """Implements ``geogs.application.structure_from_motion.photos.place_lost``."""
    features = frame_features(frames, progress)
    shown = [k for k, some in enumerate(features) if len(some) >= FEWEST_FEATURES]
    known = {place + 1: T for place, k in enumerate(shown) if (T := T_cw[k]) is not None}
    if len(known) in (0, len(shown)):
        return FoundFrames.none()
    entries = [Entry(f"{k:06d}", 0, features[k]) for k in shown]
    pairs = frame_pairs([e.features for e in entries], seed, progress)
    with tempfile.TemporaryDirectory(prefix="geogs-lost-") as work:
        database = Path(work) / "database.db"
        cameras = [SharedCamera(seen_by, is_known=True)]
        write_database(database, cameras, entries, pairs, seed, lambda f: progress("matching", f))
        model = continued(database, Path(work), known, seed, lambda f: progress("finding poses", f))
        if model is None:
            return FoundFrames.none()
        model = believed(model, database, known)
    images = placed_images(model)
    is_known = np.array([image.image_id in known for image in images], bool)
    if is_known.all():
        return FoundFrames.none()
    deviations = deviations_by_part(model, images, is_known)
    poses = np.stack([world_to_camera(image) for image in images])
    of = [frames[int(image.name)] for image in images]
    times = np.array([frame.timestamp for frame in of], np.float64)
    numbers = tuple(frame.index for frame in of)
    return FoundFrames(numbers, times, poses, *deviations).of(~is_known)


def deviations_by_part(
    model: Any, images: Sequence[Any], is_known: Bool[np.ndarray, "n"]
) -> tuple[Float64[np.ndarray, "n"], Float64[np.ndarray, "n"]]:
    """Standard deviations of the pictures' centres (world units) and orientations (radians),
    relative to the nearest known pictures; infinite if fewer than two of these are in its part, as
    one does not determine the scale.

    Known pictures at either end of a gap that matches do not bridge are separate parts: matches do
    not determine the relative pose of these.
    """
    position, rotation = np.full((2, len(images)), np.inf)
    for part in parts_of_one_scale(model, [image.image_id for image in images]):
        known = [n for n, k in enumerate(part) if is_known[k]]
        if len(known) < 2:
            continue
        own = [images[k] for k in part]
        poses = np.stack([world_to_camera(image) for image in own])
        beside = [sorted(about([n], known)) for n in range(len(own))]
        position[part], rotation[part] = pose_deviations(model, own, poses, True, beside)
    return position, rotation
