"""Sparse points to start a map from: COLMAP's triangulation of features under known poses."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.threads import thread_map, worker_count
from geogs_photos.database import Entry, SharedCamera, write_database
from geogs_photos.incremental_mapping import of_poses
from geogs_photos.photo_features import find_features
from geogs_photos.photo_pairs import choose_pairs
from geogs_photos.pycolmap_library import load_colmap


@runtime_checkable
class PosedView(Protocol):
    """An image with its mask, camera and pose."""

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """RGB."""

    @property
    def mask(self) -> Bool[np.ndarray, "h w"] | None:
        """Pixels that count; none where all do."""

    @property
    def camera(self) -> Camera:
        """Pinhole of the image."""

    @property
    def T_cw(self) -> Float64[np.ndarray, "4 4"]:
        """World to camera."""


@dataclass(frozen=True)
class StartPoints:
    """Sparse points of the scene."""

    positions: Float64[np.ndarray, "n 3"]
    """World frame."""
    colours: UInt8[np.ndarray, "n 3"]
    """RGB."""

    def __len__(self) -> int:
        return len(self.positions)


def find_start_points(views: Sequence[PosedView], seed: int = 0) -> StartPoints:
    """Find points by features, matches and triangulation; masks cut them to the visual hull.

    Raises:
        InputError: pycolmap is missing, or no point is found.
    """
    features = thread_map(lambda view: find_features(view.image, view.mask), views)
    pairs = choose_pairs(features, seed)
    cameras = list(dict.fromkeys(view.camera for view in views))
    shared = [
        SharedCamera(Calibration(c.fx, c.fy, c.cx, c.cy, width=c.width, height=c.height), True)
        for c in cameras
    ]
    entries = [
        Entry(f"{number:06d}", cameras.index(view.camera), found)
        for number, (view, found) in enumerate(zip(views, features, strict=True))
    ]
    with tempfile.TemporaryDirectory(prefix="geogs-points-") as folder:
        database = Path(folder) / "database.db"
        write_database(database, shared, entries, pairs, seed)
        model = _triangulated(database, views, seed)
    positions = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    inside = in_visual_hull(views, positions)
    if not inside.any():
        raise InputError(
            "No feature of the images could be triangulated under their poses; the images may "
            "have too little texture or overlap."
        )
    return StartPoints(positions[inside], _colours(views, model)[inside])


def in_visual_hull(
    views: Sequence[PosedView], points: Float64[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "n"]:
    """Mask of the points that no image shows outside its mask; unseen ones count as inside."""
    inside = np.ones(len(points), dtype=bool)
    for view in views:
        if view.mask is None:
            continue
        local = points @ view.T_cw[:3, :3].T + view.T_cw[:3, 3]
        z = np.where(local[:, 2] > 0, local[:, 2], 1.0)
        camera = view.camera
        u = np.rint(camera.fx * local[:, 0] / z + camera.cx).astype(np.int64)
        v = np.rint(camera.fy * local[:, 1] / z + camera.cy).astype(np.int64)
        shown = (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        inside[shown] &= view.mask[v[shown], u[shown]]
    return inside


def _triangulated(database: Path, views: Sequence[PosedView], seed: int) -> Any:
    """Reconstruct the images of a database, in their order, with the views' poses."""
    colmap = load_colmap()
    model, _ = of_poses(database, {n: view.T_cw for n, view in enumerate(views, 1)})
    options = colmap.IncrementalPipelineOptions(
        num_threads=worker_count(), random_seed=seed, extract_colors=False
    )
    options.triangulation.random_seed = seed
    written = database.parent / "model"
    written.mkdir()
    return colmap.triangulate_points(model, database, database.parent, written, options=options)


def _colours(views: Sequence[PosedView], model: Any) -> UInt8[np.ndarray, "n 3"]:
    """Mean colour of the pixels that see each point."""
    row = {number: k for k, number in enumerate(model.points3D)}
    total = np.zeros((len(row), 3))
    count = np.zeros((len(row), 1))
    for image in model.images.values():
        view = views[image.image_id - 1]
        for seen in (p for p in image.points2D if p.has_point3D()):
            u, v = np.floor(seen.xy).astype(int)
            u, v = min(u, view.camera.width - 1), min(v, view.camera.height - 1)
            total[row[seen.point3D_id]] += view.image[v, u]
            count[row[seen.point3D_id]] += 1
    return np.rint(total / count).astype(np.uint8)
