"""Frames of a video without a place, by structure from motion about others that have one."""

import tempfile
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from geogs.io.sources.calibration import Calibration
from geogs.threads import thread_map, worker_count
from geogs.types import FoundFrames, Frame
from geogs_photos.database import Entry, SharedCamera, match_pairs, write_database
from geogs_photos.deviations import deviations_beside
from geogs_photos.epipolar_agreement import agreement
from geogs_photos.fragments import firmly_joined
from geogs_photos.incremental_mapping import LEAST_POINTS, continued
from geogs_photos.photo_features import find_features
from geogs_photos.photo_pairs import choose_pairs
from geogs_photos.poses import FEWEST_FEATURES

NEXT = 6
"""Frames after each that it is matched with in any case."""
AGREE = 0.7
"""Part of a frame's verified matches with others that its pose has to explain."""
_STAGES = {"features": 0.05, "choosing pairs": 0.1, "matching": 0.65, "finding poses": 0.2}
"""Parts of the time."""


def place_lost(
    frames: Sequence[Frame],
    T_cw: Sequence[Float64[np.ndarray, "4 4"] | None],
    seen_by: Calibration,
    seed: int,
    progress: Callable[[float], None],
) -> FoundFrames:
    """As asked of it in ``geogs.application.structure_from_motion.photos.place_lost``."""
    report = partial(_report, progress)
    features = thread_map(
        lambda frame: find_features(frame.image), frames, partial(report, "features")
    )
    shown = [k for k, some in enumerate(features) if len(some) >= FEWEST_FEATURES]
    count = len(shown)
    known = {place + 1: T for place, k in enumerate(shown) if (T := T_cw[k]) is not None}
    if len(known) in (0, count):
        return FoundFrames.none()
    entries = [Entry(f"{k:06d}", 0, features[k]) for k in shown]
    alike = choose_pairs([e.features for e in entries], seed, partial(report, "choosing pairs"))
    following = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + NEXT, count))}
    pairs = sorted({*alike, *following})
    with tempfile.TemporaryDirectory(prefix="geogs-lost-") as work:
        database, threads = Path(work) / "database.db", worker_count()
        write_database(database, [SharedCamera(seen_by, is_known=True)], entries)
        match_pairs(database, entries, pairs, seed, threads, partial(report, "matching"))
        model = continued(
            database, Path(work), known, seed, threads, partial(report, "finding poses")
        )
        if model is None:
            return FoundFrames.none()
        model = firmly_joined(model, known)
        images = _believed(model, database, known)
    return _found(model, images, known, [frames[shown[i.image_id - 1]] for i in images])


def _believed(model: Any, database: Path, known: Collection[int]) -> list[Any]:
    """Pictures that were placed by enough points, and whose matches agree, by their numbers."""
    placed = {n for n, i in model.images.items() if i.has_pose and i.num_points3D >= LEAST_POINTS}
    agree = agreement(model, database, placed)
    return [model.images[n] for n in sorted(placed) if n not in known and agree[n] >= AGREE]


def _found(
    model: Any, images: Sequence[Any], known: Collection[int], frames: Sequence[Frame]
) -> FoundFrames:
    T_cw = np.tile(np.eye(4), (len(images), 1, 1))
    for pose, image in zip(T_cw, images, strict=True):
        pose[:3] = image.cam_from_world().matrix()
    numbers = tuple(frame.index for frame in frames)
    times = np.array([frame.timestamp for frame in frames], np.float64)
    return FoundFrames(numbers, times, T_cw, *deviations_beside(model, images, T_cw, known))


def _report(progress: Callable[[float], None], stage: str, fraction: float) -> None:
    """A finished part of a stage, as one of all of them."""
    before = list(_STAGES).index(stage)
    progress(sum(list(_STAGES.values())[:before]) + _STAGES[stage] * min(fraction, 1.0))
