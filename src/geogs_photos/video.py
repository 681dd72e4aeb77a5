"""Structure from motion of chosen frames of a video."""

import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from geogs.application.structure_from_motion.chosen_frames import ChosenFrames
from geogs.application.structure_from_motion.photos import PlacedVideo
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.calibration_files import calibration_from_colmap
from geogs.stopwatch import StageProgress
from geogs_photos.database import Entry, SharedCamera
from geogs_photos.deviations import pose_deviations
from geogs_photos.fragments import rejoined
from geogs_photos.incremental_mapping import (
    LEAST_IMAGES,
    adjust_free,
    placed_images,
    refine,
    world_to_camera,
)
from geogs_photos.photo_features import frame_features
from geogs_photos.photo_pairs import frame_pairs
from geogs_photos.poses import structure_of
from geogs_photos.pure_rotation import only_rotates
from geogs_photos.pycolmap_library import load_colmap
from geogs_photos.rolling_rows import with_rows_at_once
from geogs_photos.upright import make_upright
from geogs_photos.zoom import zooms

MOST_CHANGE = 0.1
"""Largest relative change of a focal length that the video determined before. With a larger one,
one of both is wrong, and shape and path bend: for a rotating camera, points at wrong distances
explain any focal length."""


def place_frames(
    chosen: ChosenFrames,
    camera: Camera,
    is_known: bool,
    is_found: bool,
    is_rolling: bool,
    seed: int,
    progress: StageProgress,
) -> PlacedVideo:
    """Implements ``geogs.application.structure_from_motion.photos.place_frames``."""
    load_colmap()  # fails at once if it is missing
    begin = Calibration(
        camera.fx, camera.fy, camera.cx, camera.cy, width=camera.width, height=camera.height,
        is_guess=not (is_known or is_found),
    )  # fmt: skip
    features = frame_features(chosen.frames, progress)
    pairs, count = frame_pairs(features, seed, progress), len(chosen.frames)
    entries = [Entry(f"{k:06d}", 0, some) for k, some in enumerate(features)]
    shared = [SharedCamera(begin, is_known)]
    with tempfile.TemporaryDirectory(prefix="geogs-video-") as work:
        database = Path(work) / "database.db"
        parts, _ = structure_of(database, shared, entries, pairs, seed, progress)
        parts = rejoined(parts, database, count, shared, seed, progress)
        if parts and only_rotates(parts[0], database):
            raise InputError(
                "The camera only turns: a turn alone explains what nearly all pairs of frames "
                "show; move it sideways, too."
            )
    best = refine(parts[0], shared) if parts else None
    images = [] if best is None else placed_images(best)
    if best is None or len(images) < LEAST_IMAGES:
        raise InputError(
            f"Of {count} sharp frames no three tell where they were taken; the camera has to move, "
            "and the scene to show texture."
        )
    make_upright(best, images, [0] * len(images))
    # Before the readout is estimated, which would explain much of a zoom.
    has_zoomed, unsure = zooms(best, images), np.zeros(len(images))
    if is_rolling:
        progress("finding the readout", 0.0)
        times = np.array([frame.timestamp for frame in chosen.frames])
        known = set(best.cameras) if is_known else set[int]()
        best, unsure = with_rows_at_once(best, times, lambda model: adjust_free(model, known))
        progress("finding the readout", 1.0)
    placed = _placed(best, chosen, entries, is_known)
    placed = replace(placed, deviation=np.hypot(placed.deviation, unsure))
    is_other = is_found and abs(math.log(placed.calibration.fx / camera.fx)) > MOST_CHANGE
    if is_other or has_zoomed:
        unknown = np.full(len(images), np.inf)
        return replace(placed, deviation=unknown, rotation=unknown, depth=unknown)
    return placed


def _placed(
    model: Any, chosen: ChosenFrames, entries: Sequence[Entry], is_known: bool
) -> PlacedVideo:
    images = placed_images(model)
    T_cw = np.stack([world_to_camera(image) for image in images])
    positions, descriptors = [], []
    for image in images:
        seen = [(k, p.point3D_id) for k, p in enumerate(image.points2D) if p.has_point3D()]
        positions.append(np.array([model.points3D[p].xyz for _, p in seen]).reshape(-1, 3))
        descriptors.append(entries[int(image.name)].features.descriptors[[k for k, _ in seen]])
    camera = next(iter(model.cameras.values()))
    calibration = calibration_from_colmap(
        camera.model.name, camera.width, camera.height, camera.params.tolist(), "the video itself"
    )
    error = float(model.compute_mean_reprojection_error())
    deviation, rotation = pose_deviations(model, images, T_cw, is_known)
    depth = np.array([_depth_deviation(model, image, error) for image in images])
    numbers = tuple(chosen.frames[int(image.name)].index for image in images)
    return PlacedVideo(
        chosen.timestamps, len(chosen.frames), numbers, T_cw, deviation, rotation, depth,
        tuple(positions), tuple(descriptors), calibration, error,
    )  # fmt: skip


def _depth_deviation(model: Any, image: Any, error: float) -> float:
    """Median relative standard deviation of the depths of an image's points, by their parallax.

    The relative standard deviation for rays that meet at an angle a is error / (f a).
    """
    focal = float(model.cameras[image.camera_id].mean_focal_length())
    centre, found = image.projection_center(), []
    for number in {p.point3D_id for p in image.points2D if p.has_point3D()}:
        point = model.points3D[number]
        others = [model.images[e.image_id] for e in point.track.elements]
        rays = np.stack([point.xyz - other.projection_center() for other in others])
        ray = point.xyz - centre
        cosine = rays @ ray / (np.linalg.norm(rays, axis=1) * np.linalg.norm(ray)).clip(1e-12)
        angle = float(np.arccos(cosine.clip(-1, 1)).max())
        found.append(error / (focal * max(angle, 1e-6)))
    return float(np.median(found)) if found else float("inf")
