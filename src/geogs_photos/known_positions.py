"""Removal of frames whose position structure from motion does not determine."""

from typing import Any

import numpy as np

from geogs.application.results.verdict import MAX_POSITION_DEVIATION
from geogs.evaluation.trajectory_errors import extent_of
from geogs_photos.deviations import pose_deviations
from geogs_photos.incremental_mapping import (
    LEAST_IMAGES,
    placed_images,
    without_poses,
    world_to_camera,
)

OUTLIER_RATIO = 3.0
"""Least ratio of an outlier's standard deviation to the median: if all are uncertain, that is left
to the verdict."""


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
