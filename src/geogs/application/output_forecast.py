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
from geogs.application.report import write_report
from geogs.application.surfaces import fusion_views
from geogs.errors import InputError
from geogs.mesh.extract import extract_mesh, plan_volume
from geogs.reconstruction import OutputCost, Reconstruction

_log = logging.getLogger(__name__)

Clock = Callable[[], float]
Share = Callable[[Sequence[int]], float]

VIEWS = 3
"""Views of the rehearsal; and of the one before it, which makes ready what is needed but once."""
CAUTION = 1.1
"""By how much more is kept than was measured, on two CPU cores: a larger volume, with more vertices
to look for in each image, and the disks, which are not there yet."""
MOST_SURFACE = 4.0
"""Times the surface of the rehearsal that is expected at most before the depths tell it: of a large
scene only a few views may be affordable, and then what was kept for its mesh is lost to them."""
WORTH = 0.05
"""Part of the time that is left which a last rehearsal may take."""


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


@dataclass(frozen=True)
class _Rehearsal:
    """Seconds that some views took."""

    report: float
    """The report, and what else is written once."""
    a_view: float
    """Each view."""
    surface: float
    """The surface that they show."""
    seconds: float
    """All of it."""


class OutputForecast:
    """What the mesh and the files are going to take, the better known the more of the map there is.

    A rehearsal does all of it with a few views, and leaves nothing.
    """

    def __init__(self, scene: Reconstruction, clock: Clock = time.perf_counter) -> None:
        self._scene = scene
        self._clock = clock
        self._views: list[int] = []
        self._found: _Rehearsal | None = None

    def first(self, times_the_surface: Share) -> OutputCost:
        """Once some depths have been searched: rehearsed twice.

        ``times_the_surface`` tells how much more surface all views show than some, given as places
        in the set.
        """
        scene = self._scene
        self._views = scene.neighbouring(VIEWS)
        _rehearse(scene, self._views[:1], self._clock)
        self._found = _rehearse(scene, self._views, self._clock)
        times = times_the_surface([scene.image_of(i) for i in self._views])
        return _cost(self._found, min(times, MOST_SURFACE))

    def settled(self, left: float) -> OutputCost:
        """Once all depths have been checked: with these, rehearsed again if that is but a small
        part of the seconds that are left."""
        scene, found = self._scene, self._found
        if found is None or found.seconds < WORTH * left:
            self._views = self._views or scene.neighbouring(VIEWS)
            found = _rehearse(scene, self._views, self._clock)
        try:
            some = plan_volume(fusion_views(scene.depth_maps(self._views)), scene.config.mesh)
            whole = plan_volume(fusion_views(scene.depth_maps()), scene.config.mesh)
            times = max(whole.blocks / some.blocks, 1.0)
        except InputError:  # no view shows anything that is sure
            times = 1.0
        return _cost(found, times)


def _cost(found: _Rehearsal, times_the_surface: float) -> OutputCost:
    once = CAUTION * (found.report + times_the_surface * found.surface)
    a_view = CAUTION * found.a_view
    _log.info(
        "mesh and files: %.1f s, %.1f times the surface, and %.3f s an image",
        once, times_the_surface, a_view,
    )  # fmt: skip
    return OutputCost(once, a_view)


def _rehearse(scene: Reconstruction, views: list[int], clock: Clock) -> _Rehearsal:
    start, mesh = clock(), None
    with tempfile.TemporaryDirectory(prefix="geogs-rehearsal-") as folder:
        renders = scene.depth_maps(of=views)
        write_keyframes(Path(folder), scene, scene.camera, renders, True)
        of_views, times = clock() - start, StageTimes(clock)
        try:
            mesh = extract_mesh(fusion_views(renders), scene.config.mesh, times)
        except InputError:  # these views show no surface: the others may
            times("merge", 1, 1)
        fused = clock()
        write_report(Path(folder) / "report", scene.trajectory(), renders, mesh, {})
        report = clock() - fused
    of_views += times.seconds.get("views", 0.0) * len(views) / max(len(views) - 1, 1)
    surface = times.seconds.get("surface", 0.0)
    return _Rehearsal(report, of_views / len(views), surface, clock() - start)
