"""Frames of a video whose place structure from motion does not know."""

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
"""Deviation over the median one: where all are unsure, that is for the verdict to say."""


def with_known_positions(model: Any, is_known: bool) -> Any:
    """A reconstruction whose frames' places its matches tell; the others lose their poses.

    What sees little but far things, or the rest of the world along one direction alone, lies
    anywhere on a line as far as its matches go, and thereby stretches the extent of the path that
    places are to be known by. So the worst go first, until all are known to
    ``MAX_POSITION_DEVIATION`` of it.

    Args:
        model: by incremental or global mapping.
        is_known: whether the camera was given, or found along with the poses.
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
