"""Time estimate of a reconstruction's mesh and files, by a trial with a few views.

One part is proportional to the views, one to the surface. Both are measured on views of the same
region, with larger voxels, and multiplied by the number of views and by the ratio of the voxels of
the whole surface.
"""

import logging
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from geogs.application.results.keyframe_files import write_keyframes
from geogs.application.results.result_page import write_page, write_pictures
from geogs.application.results.surfaces import fusion_views
from geogs.errors import InputError
from geogs.mapping.time_budget import OutputCost
from geogs.mesh.extract import extract_mesh, plan_volume
from geogs.reconstruction import Reconstruction

_log = logging.getLogger(__name__)
Clock = Callable[[], float]

VIEWS = 3
"""Number of views of the trial; before it, one view alone does the one-time preparations."""
ONE_VIEW = 0.3
"""Least weight of a surface in the trial: surface seen by one view counts, too, as all views
together will confirm it."""
COARSER = 2.0
"""Voxel size of the trial relative to the final one."""
CAUTION = 1.1
"""Safety factor on the measured time: the whole volume is larger, and there are no disks yet."""
MAX_SURFACE = 4.0
"""Largest expected surface before all depths are known, relative to the trial's: of a large scene
only a few views may be affordable, and time reserved for its mesh is lost to them."""
MAX_MESH_TIME = 0.3
"""Largest fraction of the time left for mesh and files; if they would take more, the mesh gets
fewer triangles."""
MIN_TRIANGLES = 0.25
"""Least fraction of its triangles that the mesh keeps, and at least a thousand."""


class MeshTimes:
    """Durations of the stages of mesh extraction, from its progress reports."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._last = clock()
        self.seconds: dict[str, float] = {}
        """Seconds of "views" ("fuse" and "colour") and "surface" (all else)."""

    def __call__(self, stage: str, done: int, of: int) -> None:
        """Take a report of ``extract_mesh``; time before a stage's first part is the surface's."""
        now = self._clock()
        of_views = stage in ("fuse", "colour") and done > 1
        name = "views" if of_views else "surface"
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now


@dataclass(frozen=True)
class _Rehearsal:
    """Result of a trial: seconds that some views took."""

    report: float
    """Report and other files written once."""
    a_view: float
    """Time per view."""
    surface: float
    """Time for their surface."""
    blocks: int
    """Blocks of its volume at the final voxel size."""
    triangles: int
    """Triangles of its surface at the final voxel size."""


class OutputForecast:
    """Time estimate of mesh and files, refined as the map becomes known.

    A trial does all of it with a few views, and leaves no files.
    """

    def __init__(self, scene: Reconstruction, clock: Clock = time.perf_counter) -> None:
        self._scene = scene
        self._clock = clock
        self._found: _Rehearsal | None = None

    def first(self, times_the_surface: Callable[[Sequence[int]], float]) -> OutputCost:
        """First estimate, by a trial with the depths searched so far.

        ``times_the_surface`` gives the ratio of the surface of all views to that of some, given by
        their indices. Where little time is left, the scene's mesh gets fewer triangles.
        """
        scene = self._scene
        views = _neighbouring(scene)
        _rehearse(scene, views[:1], self._clock)
        found = self._found = _rehearse(scene, views, self._clock)
        # The triangle budget limits the mesh of any surface.
        most = max(scene.config.mesh.triangle_budget / max(found.triangles, 1), 1.0)
        times = min(times_the_surface([scene.table.images[i] for i in views]), most, MAX_SURFACE)
        times *= self._affordable_triangles(found, times)
        return _cost(found, COARSER**2 * times)

    def settled(self) -> OutputCost:
        """Final estimate, by the surface of all checked depths."""
        scene = self._scene
        found = self._found
        assert found is not None, "rehearsed before"
        try:
            whole = plan_volume(fusion_views(scene.depth_maps()), scene.config.mesh)
            times = whole.blocks / found.blocks if found.blocks else 1.0
        except InputError:  # no view shows anything with confidence
            times = 1.0
        return _cost(found, COARSER**2 * times)

    def _affordable_triangles(self, found: _Rehearsal, times: float) -> float:
        """Fraction of the triangles for which there is time; sets the scene's triangle budget."""
        scene = self._scene
        mesh = self._scene.config.mesh
        surface = CAUTION * COARSER**2 * times * found.surface
        spare = MAX_MESH_TIME * scene.budget.left - CAUTION * found.report
        if mesh.voxel is not None or surface <= max(spare, 0.0):
            return 1.0
        part = max(spare / surface, MIN_TRIANGLES)
        fewer = max(round(part * times * found.triangles), 1000)
        if fewer < mesh.triangle_budget:
            scene.config = replace(scene.config, mesh=replace(mesh, triangle_budget=fewer))
        return part


def _neighbouring(scene: Reconstruction) -> list[int]:
    """Ids of neighbouring mapped keyframes."""
    mapped = scene.table.map.mapped
    views = scene.mapper.views
    return [view.id for view in views.near(views[mapped[0]], mapped, VIEWS)]


def _cost(found: _Rehearsal, times_the_surface: float) -> OutputCost:
    once = CAUTION * (found.report + times_the_surface * found.surface)
    a_view = CAUTION * found.a_view
    _log.info(
        "mesh and files: %.1f s, %.1f times those of the rehearsal, and %.3f s an image",
        once,
        times_the_surface,
        a_view,
    )
    return OutputCost(once, a_view)


def _rehearse(scene: Reconstruction, views: list[int], clock: Clock) -> _Rehearsal:
    start = clock()
    mesh = None
    blocks = 0
    triangles = 0
    config = replace(scene.config.mesh, min_weight=min(scene.config.mesh.min_weight, ONE_VIEW))
    with tempfile.TemporaryDirectory(prefix="geogs-rehearsal-") as folder:
        renders = scene.depth_maps(of=views)
        write_keyframes(Path(folder), scene, scene.camera, renders, True)
        of_views = clock() - start
        times = MeshTimes(clock)
        try:
            plan = plan_volume(fusion_views(renders), scene.config.mesh)
            blocks = plan.blocks
            triangles = plan.triangles
            coarse = replace(config, voxel=COARSER * plan.voxel)
            mesh = extract_mesh(fusion_views(renders), coarse, times)
        except InputError:  # these views show no surface; others may
            times("merge", 1, 1)
        fused = clock()
        write_pictures(Path(folder) / "report", renders)
        write_page(Path(folder) / "report", scene.trajectory(), renders, mesh, {})
        report = clock() - fused
    of_views += times.seconds.get("views", 0.0) * len(views) / max(len(views) - 1, 1)
    surface = times.seconds.get("surface", 0.0)
    return _Rehearsal(report, of_views / len(views), surface, blocks, triangles)
