"""What the mesh and the files of a reconstruction are going to take: a rehearsal with a few views.

Some of it is done once for each view, some once for each piece of the surface. Both are measured on
views that show the same place, and multiplied by how many views there are and how much more surface
all of them show. What is needed but once, such as compiled code, is made ready by then.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from geogs.application.keyframe_files import write_keyframes
from geogs.application.splat_colours import splat_colours
from geogs.application.surfaces import fusion_views
from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.mesh.extract import extract_mesh, plan_volume
from geogs.mesh.tsdf import BLOCK
from geogs.reconstruction import Reconstruction

Clock = Callable[[], float]

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


def output_seconds(scene: Reconstruction, clock: Clock = time.perf_counter) -> float:
    """Seconds that rendering all mapped views, the mesh and the files are going to take.

    Called when the map has grown; it does all of that for a few views, twice, and writes nothing
    that stays.
    """
    views = scene.neighbouring(VIEWS)
    _rehearse(scene, views[:1], clock)
    a_view, surface = _rehearse(scene, views, clock)
    return REPORT + a_view * scene.with_depth + surface * _times_the_surface(scene, views)


def _rehearse(scene: Reconstruction, views: list[int], clock: Clock) -> tuple[float, float]:
    """Seconds for each of some views, and for the surface that they show."""
    start = clock()
    renders = scene.renders(of=views)
    with tempfile.TemporaryDirectory(prefix="geogs-rehearsal-") as folder:
        write_keyframes(Path(folder), scene, scene.camera, renders, True)
    splat_colours(scene.snapshot(), fusion_views(renders))
    of_views, times = clock() - start, StageTimes(clock)
    try:
        extract_mesh(fusion_views(renders), scene.config.mesh, times)
    except InputError:  # these views show no surface: the others may
        times("merge", 1, 1)
    of_views += times.seconds.get("views", 0.0) * len(views) / max(len(views) - 1, 1)
    return of_views / len(views), times.seconds.get("surface", 0.0)


def _times_the_surface(scene: Reconstruction, views: list[int]) -> float:
    """How much more surface all views show than some of them."""
    config = scene.config.mesh
    try:
        some = _blocks(scene, config, views)
        return max(_blocks(scene, config, None) / some, 1.0)
    except InputError:
        return scene.with_depth / len(views)


def _blocks(scene: Reconstruction, config: MeshConfig, views: list[int] | None) -> float:
    """Voxels of the surface that views show, in blocks' area."""
    plan = plan_volume(fusion_views(scene.depth_maps(of=views)), config)
    return plan.blocks / BLOCK
