"""What the mesh and the files of a reconstruction are going to take: a rehearsal with a few views.

Some of it is done once for each view, some once for each piece of the surface. Both are measured on
views that show the same place, and multiplied by how many views there are and how much more surface
all of them show. What is needed but once, such as compiled code, is made ready by then.
"""

import logging
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from geogs.application.keyframe_files import write_keyframes
from geogs.application.surfaces import fusion_views
from geogs.errors import InputError
from geogs.mesh.extract import extract_mesh
from geogs.reconstruction import OutputCost, Reconstruction

_log = logging.getLogger(__name__)

Clock = Callable[[], float]
Share = Callable[[Sequence[int]], float]

VIEWS = 3
"""Views of the rehearsal; and of the one before it, which makes ready what is needed but once."""
REPORT = 5.0
"""What the report takes, and what else is written once, in times of one picture of the path."""
CAUTION = 1.35
"""By how much more is kept than was measured, on two CPU cores: a larger volume, with more vertices
to look for in each image, and the disks, which are not there yet."""


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
    cost = _rehearse(scene, views, clock)
    surface = times_the_surface([scene.image_of(i) for i in views]) * cost.surface
    found = OutputCost(CAUTION * (REPORT * cost.picture + surface), CAUTION * cost.a_view)
    _log.info("mesh and files: %.1f s, and %.3f s for each image", found.once, found.a_view)
    return found


@dataclass(frozen=True)
class _Rehearsal:
    """Seconds that some views took."""

    picture: float
    """A picture of the path."""
    a_view: float
    """Each view."""
    surface: float
    """The surface that they show."""


def _rehearse(scene: Reconstruction, views: list[int], clock: Clock) -> _Rehearsal:
    from geogs.evaluation.plots import plot_path

    start = clock()
    with tempfile.TemporaryDirectory(prefix="geogs-rehearsal-") as folder:
        plot_path(Path(folder) / "trajectory.png", scene.trajectory())
        drawn = clock()
        renders = scene.depth_maps(of=views)
        write_keyframes(Path(folder), scene, scene.camera, renders, True)
    of_views, times = clock() - drawn, StageTimes(clock)
    try:
        extract_mesh(fusion_views(renders), scene.config.mesh, times)
    except InputError:  # these views show no surface: the others may
        times("merge", 1, 1)
    of_views += times.seconds.get("views", 0.0) * len(views) / max(len(views) - 1, 1)
    return _Rehearsal(drawn - start, of_views / len(views), times.seconds.get("surface", 0.0))
