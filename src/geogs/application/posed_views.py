"""The images of a source that make the map: chosen by where they were taken, then read."""

from collections.abc import Callable, Iterator, Sequence
from itertools import islice

import numpy as np
from jaxtyping import Float64

from geogs.config import ReconstructConfig
from geogs.depth.view import Place
from geogs.io.sources.base import read_ahead
from geogs.io.sources.posed.base import PosedSource
from geogs.mapping.first_look import SmallImage, first_points
from geogs.mapping.known_poses import FEWEST_POINTS, depth_search
from geogs.mapping.view_choice import (
    coverage_order,
    relative_sharpness,
    scene_points,
    sightings,
)
from geogs.reconstruction import Reconstruction
from geogs.types import Trajectory

Report = Callable[[str, float], None]
"""Called with the name of a stage and its finished fraction in [0, 1]."""

# Points of the scene by which the usual depth of each image is told, at most.
_TELLING_POINTS = 4000


class PosedViews:
    """Gives a reconstruction the images of a source, those first that say most.

    An image is read when it is given, the next one meanwhile; none is kept here.
    """

    def __init__(self, scene: Reconstruction, source: PosedSource, report: Report) -> None:
        self._scene = scene
        self._source = source
        self._report = report
        self._order: Iterator[int] = iter(())
        T_wc = np.linalg.inv(source.T_cw)
        known = np.ones(len(source), dtype=bool)
        scene.know(Trajectory(source.timestamps, T_wc, known))

    def first_look(self) -> Float64[np.ndarray, "n 3"]:
        """Points of the scene: those of the source, or where some small images match.

        Raises:
            InputError: hardly anything matches anywhere.
        """
        source, config = self._source, self._scene.config
        if source.points is not None and len(source.points.positions) >= FEWEST_POINTS:
            return source.points.positions

        def image_at(index: int) -> SmallImage:
            image = source[index]
            return image.image, image.mask

        places = [Place(i, T_cw) for i, T_cw in enumerate(source.T_cw)]
        with self._scene.stopwatch("first look"):
            return first_points(
                places, image_at, source.camera, config.mapping.depth, config.search,
                lambda fraction: self._report("first look", fraction),
            )  # fmt: skip

    def choose(self, points: Float64[np.ndarray, "n 3"]) -> None:
        """Put the images into an order in which every beginning shows the scene well."""
        with self._scene.stopwatch("choosing views"):
            order = order_of(self._source, points, self._scene.config)
        self._order = islice(order, self._scene.config.search.most_views)

    def give(self, count: int | None = None) -> None:
        """The next so many images, or all that there are.

        Raises:
            InputError: an image cannot be read.
        """
        with self._scene.stopwatch("choosing views"):
            places = list(islice(self._order, count))
        self.give_these(places)

    def give_these(self, places: Sequence[int]) -> None:
        """The images at some places of the source, in this order."""
        source, scene = self._source, self._scene
        for done, image in enumerate(read_ahead(source[i] for i in places)):
            scene.add(image.image, image.T_cw, image.mask, image.timestamp, image.index)
            self._report("reading", (done + 1) / len(places))


def order_of(
    source: PosedSource, points: Float64[np.ndarray, "n 3"], config: ReconstructConfig
) -> Iterator[int]:
    """Places of the images in the source, the one that adds most first, without copies."""
    T_cw, camera = source.T_cw, source.camera
    some = points[:: 1 + len(points) // _TELLING_POINTS]
    typical = np.array(
        [depth_search(Place(i, T), some, camera, 1.0).typical for i, T in enumerate(T_cw)]
    )
    random = np.random.default_rng(config.seed)
    seen = sightings(T_cw, camera, typical, scene_points(T_cw, camera, typical, random))
    sharpness = relative_sharpness(T_cw, float(np.median(typical)), source.stored_bytes())
    return coverage_order(seen, config.mapping.depth, sharpness)
