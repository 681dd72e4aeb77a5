"""What the mesh and the files of a reconstruction are going to take: a rehearsal with a few views.

Some of it is done once for each view, some once for each piece of the surface. Both are measured on
views that show the same place, and multiplied by how many views there are and how much more surface
all of them show. What is needed but once, such as compiled code, is made ready by then.
"""

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from geogs.application.keyframe_files import write_keyframes
from geogs.application.surfaces import fusion_views
from geogs.errors import InputError
from geogs.mesh.extract import extract_mesh
from geogs.reconstruction import OutputCost, Reconstruction

Clock = Callable[[], float]
Share = Callable[[Sequence[int]], float]

VIEWS = 3
"""Views of the rehearsal; and of the one before it, which makes ready what is needed but once."""
REPORT = 2.0
"""Seconds of the report and of what else is written that does not depend on the views."""


class StageTimes:
    """How long the stages of a mesh take, from the reports of its progress."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._last = clock()
        self.seconds: dict[str, float] = {}
        """By stage: "fuse" and "colour" of the views, all else of the surface."""

    def __call__(self, stage: str, done: int, of: int) -> None:
        """As ``extract_mesh`` reports; time before the first part of a stage is the surface's."""
        now = self._clock()
        of_views = stage in ("fuse", "colour") and done > 1
        name = "views" if of_views else "surface"
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now


def output_cost(
    scene: Reconstruction, times_the_surface: Share, clock: Clock = time.perf_counter
) -> OutputCost:
    """What the mesh and the files are going to take.

    Called when some depths have been searched. Of a few views all of it is done with these, twice,
    and nothing stays. ``times_the_surface`` tells how much more surface all views show than some,
    given as places in the set.
    """
    views = scene.neighbouring(VIEWS)
    _rehearse(scene, views[:1], clock)
    a_view, surface = _rehearse(scene, views, clock)
    more = times_the_surface([scene.image_of(i) for i in views])
    return OutputCost(REPORT + more * surface, a_view)


def _rehearse(scene: Reconstruction, views: list[int], clock: Clock) -> tuple[float, float]:
    """Seconds for each of some views, and for the surface that they show."""
    start = clock()
    renders = scene.depth_maps(of=views)
    with tempfile.TemporaryDirectory(prefix="geogs-rehearsal-") as folder:
        write_keyframes(Path(folder), scene, scene.camera, renders, True)
    of_views, times = clock() - start, StageTimes(clock)
    try:
        extract_mesh(fusion_views(renders), scene.config.mesh, times)
    except InputError:  # these views show no surface: the others may
        times("merge", 1, 1)
    of_views += times.seconds.get("views", 0.0) * len(views) / max(len(views) - 1, 1)
    return of_views / len(views), times.seconds.get("surface", 0.0)
