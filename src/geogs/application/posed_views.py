"""The images of a source for the map: selected by their poses, then read."""

from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np
from jaxtyping import Float64

from geogs.application.structure_from_motion.photos import triangulated_points
from geogs.depth.depth_view import ViewPose
from geogs.errors import InputError
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.sources.reader import read_side_by_side
from geogs.mapping.coverage import (
    Sightings,
    coverage_order,
    relative_sharpness,
    scene_points,
    sightings,
)
from geogs.mapping.first_look import SmallImage, first_points
from geogs.mapping.known_poses import FEWEST_POINTS, depth_search
from geogs.mapping.map_all import spread_order
from geogs.reconstruction import Reconstruction
from geogs.stopwatch import StageProgress
from geogs.types import Trajectory


class PosedViews:
    """Gives a reconstruction the images of a source, the most informative first.

    An image is read when it is given, and the next one ahead; none is kept here.
    """

    def __init__(self, scene: Reconstruction, source: PosedSource, report: StageProgress) -> None:
        self._scene = scene
        self._source = source
        self._report = report
        self._order: Iterator[int] = iter(())
        self._seen: Sightings | None = None
        T_wc = np.linalg.inv(source.T_cw)
        known = np.ones(len(source), dtype=bool)
        scene.know(Trajectory(source.timestamps, T_wc, known))

    def first_look(self) -> Float64[np.ndarray, "n 3"]:
        """Find points of the scene: those of the source, or by matching some small images.

        If the map starts from points and the source has none, image features are triangulated, in
        evenly spread images if there are too many.

        Raises:
            InputError: there is one image only, or hardly anything matches anywhere.
        """
        source = self._source
        if len(source) < 2:
            raise InputError("There is only 1 image; depth needs at least two.")
        if source.points is not None and len(source.points.positions) >= FEWEST_POINTS:
            return source.points.positions

        config = self._scene.config
        if config.mapping.ablation.start == "points":
            which = spread_order(range(len(source)))[: config.search.most_views]
            with self._scene.stopwatch("first look"):
                return triangulated_points(source, sorted(which), config.seed)

        def image_at(index: int) -> SmallImage:
            image = source[index]
            return image.image, image.mask

        poses = [ViewPose(i, T_cw) for i, T_cw in enumerate(source.T_cw)]
        with self._scene.stopwatch("first look"):
            return first_points(
                poses,
                image_at,
                source.camera,
                lambda fraction: self._report("first look", fraction),
            )

    def choose(self, points: Float64[np.ndarray, "n 3"]) -> None:
        """Order the images such that each prefix covers the scene well."""
        with self._scene.stopwatch("choosing views"):
            source = self._source
            config = self._scene.config
            typical = usual_depths(source, points)
            random = np.random.default_rng(config.seed)
            shown = scene_points(source.T_cw, source.camera, typical, random)
            self._seen = sightings(source.T_cw, source.camera, typical, shown)
            usual = float(np.median(typical))
            sharpness = relative_sharpness(source.T_cw, usual, source.stored_bytes())
            order = coverage_order(self._seen, sharpness)
        self._order = islice(order, config.search.most_views)

    def give(self, count: int | None = None) -> None:
        """Add the next ``count`` images to the scene, or all.

        Raises:
            InputError: an image cannot be read.
        """
        with self._scene.stopwatch("choosing views"):
            indices = list(islice(self._order, count))
        self.give_these(indices)

    def give_these(self, indices: Sequence[int]) -> None:
        """Add the images with these indices to the scene, in this order."""
        source = self._source
        scene = self._scene
        for done, image in enumerate(read_side_by_side(source.__getitem__, indices)):
            scene.add(image.image, image.T_cw, image.mask, image.timestamp, image.index)
            self._report("reading", (done + 1) / len(indices))

    def times_the_surface(self, indices: Sequence[int]) -> float:
        """Ratio of the scene points seen by all images to those seen by some indices."""
        if self._seen is None:
            return 1.0
        some = np.isin(self._seen.view, indices)
        part = len(np.unique(self._seen.point[some])) / len(np.unique(self._seen.point))
        return 1.0 / max(part, 1e-3)


def usual_depths(
    source: PosedSource, points: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "v"]:
    """Median depth of the points that each image sees."""
    # Largest number of scene points for the typical depth of each image.
    some = points[:: 1 + len(points) // 4000]
    poses = [ViewPose(i, T_cw) for i, T_cw in enumerate(source.T_cw)]
    return np.array([depth_search(pose, some, source.camera, 1.0).typical for pose in poses])
