"""Keyframe files of a result, which allow its further use."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geogs.geometry.camera import Camera
from geogs.io.writers.keyframe_folder import (
    image_path,
    mask_path,
    rows_path,
    write_image,
    write_mask,
    write_rows,
)
from geogs.io.writers.map_file import MapViews
from geogs.types import RenderedKeyframe

if TYPE_CHECKING:
    from geogs.application.results.mapped_scene import MappedScene


def write_keyframes(
    folder: Path,
    scene: "MappedScene",
    camera: Camera,
    renders: Sequence[RenderedKeyframe],
    with_images: bool,
) -> MapViews:
    """Write masks, working images and rows to ``keyframes/``. Returns the other data.

    Args:
        folder: folder of the result.
        scene: scene of the map.
        camera: camera of the images.
        renders: the map seen from the keyframes.
        with_images: whether images and rows are written.

    Raises:
        OutputError: a file cannot be written.
    """
    ids = []
    times = []
    poses = []
    masked = []
    for render in renders:
        ids.append(render.keyframe_id)
        times.append(render.timestamp)
        poses.append(render.T_cw.numpy())
        masked.append(render.mask is not None)
        if render.mask is not None:
            write_mask(mask_path(folder, render.keyframe_id), render.mask.cpu().numpy())
        if with_images and render.image is not None:
            write_image(image_path(folder, render.keyframe_id), render.image)
    rows = scene.rows() if with_images else {}
    kept = {id: rows[id] for id in ids if id in rows}
    if kept:
        write_rows(rows_path(folder), kept)
    renderer = scene.renderer()
    return MapViews(
        camera=camera,
        render_camera=renderer.camera,
        min_alpha=renderer.rules.min_alpha,
        max_spread=renderer.rules.max_spread,
        plane_reach=renderer.rules.plane_reach,
        origin=renderer.frame.origin,
        unit=renderer.frame.unit,
        disks=renderer.disks,
        keyframe_id=np.array(ids, np.int64),
        timestamp=np.array(times, np.float64),
        T_cw=np.array(poses, np.float64).reshape(-1, 4, 4),
        has_mask=np.array(masked, bool),
        has_images=with_images,
    )
