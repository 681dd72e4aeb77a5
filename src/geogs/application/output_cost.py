"""What the mesh and the files of a reconstruction are going to take: a rehearsal with a few views.

Some of it is done once for each view, some once for each piece of the surface. Both are measured on
views that show the same place, with larger voxels, and multiplied by how many views there are and
how many more voxels the surface of all of them has.
"""

import logging
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from geogs.application.progress.forecast import Clock
from geogs.application.results.keyframe_files import write_keyframes
from geogs.application.results.result_page import write_page, write_pictures
from geogs.application.results.surfaces import fusion_views
from geogs.errors import InputError
from geogs.mapping.time_budget import OutputCost
from geogs.mesh.extract import extract_mesh, plan_volume
from geogs.reconstruction import Reconstruction

_log = logging.getLogger(__name__)

VIEWS = 3
"""Views of the rehearsal; one of them alone makes ready what is needed but once, before it."""
ONE_VIEW = 0.3
"""Weight from which a surface counts in a rehearsal: what one view has seen is part of it, too, as
all views together are going to confirm it."""
COARSER = 2.0
"""Size of a voxel of a rehearsal, in voxels that all views are going to have."""
CAUTION = 1.1
"""Factor on what was measured: the whole volume is larger, and the disks are not there yet."""
MAX_SURFACE = 4.0
"""Largest surface that is expected before the depths tell it, in surfaces of the rehearsal: of a
large scene only a few views may be affordable, and what is kept for its mesh is lost to them."""
MAX_MESH_TIME = 0.3
"""Fraction of the time left which mesh and files may take; where they would take more, the mesh
gets fewer triangles."""
MIN_TRIANGLES = 0.25
"""Fraction of its triangles that it keeps in any case, and not fewer than a thousand."""


class MeshTimes:
    """How long the stages of a mesh take, from the reports of its progress."""

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
    """Seconds that some views took."""

    report: float
    """The report, and what else is written once."""
    a_view: float
    """Each view."""
    surface: float
    """The surface that they show."""
    blocks: int
    """Blocks of its volume, had its voxels been as small as planned."""
    triangles: int
    """Triangles of its surface, likewise."""


class OutputForecast:
    """What the mesh and the files are going to take, the better known the more of the map there is.

    A rehearsal does all of it with a few views, and leaves nothing.
    """

    def __init__(self, scene: Reconstruction, clock: Clock = time.perf_counter) -> None:
        self._scene = scene
        self._clock = clock
        self._found: _Rehearsal | None = None

    def first(self, times_the_surface: Callable[[Sequence[int]], float]) -> OutputCost:
        """Once some depths have been searched: rehearsed with these.

        ``times_the_surface`` gives how much more surface all views show than some, given by their
        indices. Where little time is left, the scene's mesh gets a smaller budget of triangles.
        """
        scene = self._scene
        views = _neighbouring(scene)
        _rehearse(scene, views[:1], self._clock)
        found = self._found = _rehearse(scene, views, self._clock)
        # However much surface there is, its triangles are no more than this.
        most = max(scene.config.mesh.triangle_budget / max(found.triangles, 1), 1.0)
        times = min(times_the_surface([scene.table.images[i] for i in views]), most, MAX_SURFACE)
        times *= self._affordable_triangles(found, times)
        return _cost(found, COARSER**2 * times)

    def settled(self) -> OutputCost:
        """Once all depths have been checked: with the surface that these show."""
        scene, found = self._scene, self._found
        assert found is not None, "rehearsed before"
        try:
            whole = plan_volume(fusion_views(scene.depth_maps()), scene.config.mesh)
            times = whole.blocks / found.blocks if found.blocks else 1.0
        except InputError:  # no view shows anything with confidence
            times = 1.0
        return _cost(found, COARSER**2 * times)

    def _affordable_triangles(self, found: _Rehearsal, times: float) -> float:
        """The part of the triangles for which there is time; the scene's mesh is set so."""
        scene, mesh = self._scene, self._scene.config.mesh
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
    """Ids of mapped keyframes that were taken near each other."""
    mapped, views = scene.table.map.mapped, scene.mapper.views
    return [view.id for view in views.near(views[mapped[0]], mapped, VIEWS)]


def _cost(found: _Rehearsal, times_the_surface: float) -> OutputCost:
    once = CAUTION * (found.report + times_the_surface * found.surface)
    a_view = CAUTION * found.a_view
    _log.info(
        "mesh and files: %.1f s, %.1f times those of the rehearsal, and %.3f s an image",
        once, times_the_surface, a_view,
    )  # fmt: skip
    return OutputCost(once, a_view)


def _rehearse(scene: Reconstruction, views: list[int], clock: Clock) -> _Rehearsal:
    start, mesh, blocks, triangles = clock(), None, 0, 0
    config = replace(scene.config.mesh, min_weight=min(scene.config.mesh.min_weight, ONE_VIEW))
    with tempfile.TemporaryDirectory(prefix="geogs-rehearsal-") as folder:
        renders = scene.depth_maps(of=views)
        write_keyframes(Path(folder), scene, scene.camera, renders, True)
        of_views, times = clock() - start, MeshTimes(clock)
        try:
            plan = plan_volume(fusion_views(renders), scene.config.mesh)
            blocks, triangles = plan.blocks, plan.triangles
            coarse = replace(config, voxel=COARSER * plan.voxel)
            mesh = extract_mesh(fusion_views(renders), coarse, times)
        except InputError:  # these views show no surface: the others may
            times("merge", 1, 1)
        fused = clock()
        write_pictures(Path(folder) / "report", scene.trajectory(), renders)
        write_page(Path(folder) / "report", scene.trajectory(), renders, mesh, {})
        report = clock() - fused
    of_views += times.seconds.get("views", 0.0) * len(views) / max(len(views) - 1, 1)
    surface = times.seconds.get("surface", 0.0)
    return _Rehearsal(report, of_views / len(views), surface, blocks, triangles)
