"""The back end: keyframe depths in, a trained disk map and refined poses out."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.config import DepthSensorConfig, MappingConfig
from geogs.depth.depth_engine import Progress, silent
from geogs.depth.engine_choice import depth_engine
from geogs.mapping.disk_growth import DiskGrowth
from geogs.mapping.keyframe_depths import KeyframeDepths
from geogs.mapping.keyframe_views import KeyframeViews, MapView
from geogs.mapping.map_frame import WORLD, MapFrame
from geogs.mapping.map_update import covisible_keyframe, plan_update
from geogs.mapping.partners import Partners
from geogs.mapping.rendered import (
    MapRenderer,
    SurfaceRules,
    rendered_keyframe,
    rendered_surface,
    searched_keyframe,
    shown_depth,
    stored_render,
)
from geogs.mapping.training.full import FullTraining
from geogs.mapping.training.map_trainer import draw_batch, draw_views
from geogs.mapping.training.trainer_choice import map_trainer
from geogs.mapping.view_arrays import MapCameras, ViewArrays
from geogs.on_demand import OnDemand
from geogs.types import MapSnapshot, PoseCorrection, RenderedKeyframe
from geogs.world.archive import Archive
from geogs.world.disks import DiskParameters
from geogs.world.keyframes import KeyframeTable
from geogs.world.map import MapTable, TrainingPlace, check_map

if TYPE_CHECKING:
    from geogs.mapping.training.trainer_choice import MapTrainer

CARVE_EVERY = 10
"""Keyframes between two votes of all nearby keyframes on disks in free space, which take time."""
# Most keyframes by which the map follows a correction: neighbours move alike.
_COVISIBLE = 256
SEARCHED = 0.4
"""Fraction of the time for depths and training that the search of all depths takes."""


def never_pause() -> None:
    """Do nothing: never give way to other threads."""


class Mapper:
    """Grows and trains the map keyframe by keyframe.

    ``observe`` takes final keyframes as images to match with; ``map_keyframe`` makes one of them
    part of the map. Poses are always the current ones of the keyframes. Everything is in the
    tracker's units; settings that are lengths are scaled by the median depth of the first keyframe.
    """

    def __init__(
        self,
        keyframes: KeyframeTable,
        config: MappingConfig,
        seed: int = 0,
        sensor: DepthSensorConfig | None = None,
        table: MapTable | None = None,
    ):
        """Continue the map of a ``table``, whose keyframes are given, or begin an empty one.

        Raises:
            InputError: the table is incomplete, or of other keyframes.
        """
        self.config = config
        self.keyframes = keyframes
        self.cameras = MapCameras.of(keyframes.camera, config)
        render = self.cameras.render
        if table is None:
            table = MapTable.empty(keyframes.grid.device, seed)
        check_map(table, keyframes, (render.height, render.width))
        self.table = table
        self.views = KeyframeViews(ViewArrays(table, keyframes, self.cameras, config.loss))
        working = self.cameras.working
        resident = keyframes.arrays.resident
        engine = depth_engine(table.disks.device, render, working, config.depth, resident)
        self.depths = KeyframeDepths(engine, self.views, sensor, config.depth.bare_planes)
        self.partners = Partners(self.views, table, config.photo)
        self.growth = DiskGrowth(table, self.depths, config)
        self._trainer: MapTrainer | None = None
        self.pause: Callable[[], None] = never_pause
        """Called between the parts of the work on a keyframe, to give way to other threads."""

    @property
    def trainer(self) -> "MapTrainer":
        """The trainer of the disks, made when a keyframe is mapped."""
        if self._trainer is None:
            if self.table.unit is None:
                self.table.unit = _unit(self.views[self.table.mapped[0]])
            scene = (self.table.disks, self.cameras, self.config, self.table.unit)
            self._trainer = map_trainer(*scene, self.keyframes.arrays.resident)
        return self._trainer

    def settle(self) -> None:
        """Write to the table what is in memory alone, so that it can be packed."""
        self.views.arrays.settle()
        self.table.random.settle()

    def move_to(self, keyframes: KeyframeTable) -> None:
        """Replace the keyframes by equal ones."""
        self.keyframes = self.views.arrays.keyframes = keyframes

    # --- keyframe by keyframe --------------------------------------------------------------

    def observe(self, keyframe_id: int, mask: Bool[np.ndarray, "h w"] | None = None) -> None:
        """Add a final keyframe for matching; it has no depth outside a mask of its image's size."""
        view = self.views.add(keyframe_id, mask)
        self.depths.engine.observe(view.depth_view)

    def see_anew(self, masks: Mapping[int, Bool[np.ndarray, "h w"] | None]) -> None:
        """Use the current images of all keyframes, and new masks."""
        for id, mask in masks.items():
            if mask is not None:
                self.views.arrays.put_mask(id, mask)
        self.views.arrays.forget_images()
        for view in self._searched():
            self.depths.engine.observe(view.depth_view)

    def take_over(
        self, disks: MapSnapshot, masks: Mapping[int, Bool[np.ndarray, "h w"]], ids: Sequence[int]
    ) -> None:
        """Begin with a saved map and its keyframes.

        Their depths are rendered from the map, inside ``masks``, and are not searched again.
        """
        parameters = DiskParameters.of(disks)
        rules = SurfaceRules.of(self.config)
        for i in ids:
            self.observe(i, masks.get(i))
            view = self.views[i]
            shown = rendered_surface(parameters, self.cameras.render, view.T_cw, rules, view.mask)
            view.set_depth(shown_depth(shown))
        self.table.mapped, self.table.given = [*ids], [*ids]
        self.table.unit = _unit(self.views[ids[0]])
        self.partners.choose(self._mapped())
        self.table.disks.append(parameters, ids[0])
        self.table.disks.seen.fill_(1)

    def map_keyframe(self, keyframe_id: int) -> None:
        """Give a keyframe its depth, carve and grow the map with it, train the window."""
        view = self.views[keyframe_id]
        table = self.table
        disk = self.config.disk
        random = table.random.of_numpy
        mapped = [*table.mapped, keyframe_id]
        drawn = draw_views(mapped, self.config.iterations, self.config, random)
        # Old views are read from a file while the depth is searched.
        self.views.arrays.read_ahead({i for ids in drawn for i in ids if i != keyframe_id})
        self.depths.estimate(self._due(keyframe_id), lambda _: self.pause())
        self.pause()
        self.depths.check([view])
        self.pause()
        table.mapped.append(keyframe_id)
        self.partners.choose([view])
        trainer = self.trainer
        self.growth.carve([view, *self.depths.near(view)])
        self.pause()
        self.growth.insert(view, disk.insert_confidence)
        if len(mapped) > self.config.window:
            left = self.views[mapped[-1 - self.config.window]]
            self.growth.insert(left, disk.fill_confidence)
        batches = [draw_batch(ids, self.views, self.config, random) for ids in drawn]
        self.views.arrays.read_ahead(
            {v.id for b in batches for own, others in b for v in (own, *others)}
        )
        self.pause()
        trainer.train(batches)
        self.pause()
        if len(mapped) % CARVE_EVERY == 0:
            self.growth.prune(self.growth.voters(view))

    def refine_poses(self, active: Sequence[int]) -> None:
        """Give the active keyframes poses that agree better with the map; the earliest stays."""
        active = [i for i in active if i not in self.table.given]
        views = [self.views[i] for i in active if i in self.views and self.views[i].has_depth]
        if len(views) < 2 or len(self.table.disks) == 0:
            return
        poses = self.trainer.refine_poses(views, self.views, self.config)
        for i, T_cw in poses.items():
            self.keyframes[i].T_cw = T_cw

    def correct(self, correction: PoseCorrection) -> None:
        """Move the map with a global correction that was applied to the keyframes."""
        views = [v for v in self.views.values() if v.has_depth]
        views = views[:: 1 + len(views) // _COVISIBLE]
        disks = self.table.disks
        covisible = (covisible_keyframe(v, correction) for v in views)
        strategy = self.config.ablation.map_update
        moves = plan_update(disks.position, disks.keyframe_id, correction, strategy, covisible)
        if len(disks):
            disks.transform(moves)
            self.trainer.forget_renders(self.views.values())

    # --- all keyframes at once -------------------------------------------------------------

    def search_depths(self, keyframe_ids: Sequence[int]) -> None:
        """Search the depths of some keyframes in their images; they count as mapped then."""
        self.depths.estimate([self.views[i] for i in keyframe_ids])
        self.table.mapped = sorted({*self.table.mapped, *keyframe_ids})

    def check_depths(self) -> None:
        """Check the depths of all mapped keyframes by each other, once per search."""
        self.depths.check(self._searched())

    def grow(self, points: Float[Tensor, "n 3"] | None = None) -> None:
        """Carve the map with all mapped keyframes, and add disks where their depths show more.

        If the settings start disks at points, add disks at ``points`` instead.
        """
        views = self._mapped()
        self.partners.choose(views)
        if points is not None and self.config.ablation.start == "points":
            self.growth.start(points.to(self.table.disks.position), views)
            return
        self.growth.prune(views)
        for view in views:
            self.growth.insert(view, self.config.disk.insert_confidence)

    def refine(self, progress: Progress = silent) -> None:
        """Train over all mapped keyframes, at least one, with the final poses, after searching
        their depths again if the settings require it."""
        searched = self._searched()
        start = SEARCHED if self.config.final_depth else 0.0
        if self.config.final_depth and searched:
            self.depths.estimate(searched, lambda fraction: progress(SEARCHED * fraction))
            self.check_depths()
        self.grow()
        steps = self.config.final_steps(self.keyframes.grid.on_gpu)
        self.train(steps, lambda fraction: progress(start + (1 - start) * fraction))

    def train(
        self,
        steps: int,
        progress: Progress = silent,
        until: float | None = None,
        goes_on: bool = False,
    ) -> None:
        """Single-view steps over all mapped keyframes; disks that none has seen are removed.

        Fewer steps where they would last beyond ``until``, a time of ``time.perf_counter``. With
        ``goes_on`` an interrupted training is continued.
        """
        if not goes_on:
            self.table.place, self.table.order = TrainingPlace(), []
        training = FullTraining(self.table, self.views, self.trainer, self.growth, self.config)
        training.run(steps, progress, until)
        self.growth.prune(self._mapped())
        self.table.disks.keep(self.table.disks.seen > 0)

    # --- results ---------------------------------------------------------------------------

    @torch.no_grad()
    def renders(
        self, disks: MapSnapshot | None = None, of: Sequence[int] | None = None
    ) -> Sequence[RenderedKeyframe]:
        """The map, or other disks in its frame, rendered from all mapped keyframes, or from some.

        They are rendered now, from a snapshot, as disks in a file would be. For a long video most
        renderings are read from a temporary file on access.

        Raises:
            OutputError: the disk is full, or cannot be written.
        """
        parameters = DiskParameters.of(self.table.disks.snapshot() if disks is None else disks)
        archive = Archive()
        stored = []
        rules = SurfaceRules.of(self.config)
        for view in self._mapped(of):
            render = rendered_keyframe(view, parameters, rules)
            stored.append(stored_render(render, self.keyframes.reader(view.id), archive))
        return OnDemand(stored, lambda load: load())

    def renderer(self, frame: MapFrame = WORLD) -> MapRenderer:
        """A renderer of the current map from any pose in the world that ``frame`` relates to it."""
        rules = SurfaceRules.of(self.config)
        return MapRenderer(self.table.disks.snapshot(), frame, self.cameras.render, rules)

    def depth_maps(self, of: Sequence[int] | None = None) -> Sequence[RenderedKeyframe]:
        """The dense depths of all mapped keyframes, or of some, weighted by confidence.

        They are not rendered; each is read on access, as it is then.
        """
        return OnDemand(self._mapped(of), searched_keyframe)

    def _mapped(self, ids: Sequence[int] | None = None) -> list[MapView]:
        """Views of all mapped keyframes, or of some."""
        return [self.views[i] for i in (self.table.mapped if ids is None else ids)]

    def _searched(self) -> list[MapView]:
        """The mapped keyframes whose depths are searched: not those of a saved map."""
        return self._mapped([i for i in self.table.mapped if i not in self.table.given])

    def _due(self, keyframe_id: int) -> list[MapView]:
        """The keyframe and its successors whose depths are searched now, to check each other.

        If depths are the tracker's own, those of the window are taken again, too.
        """
        later = [i for i in self.views if i >= keyframe_id][: 1 + self.config.lag // 2]
        if self.config.depth.engine == "tracker":
            return self._mapped([*self.table.mapped[-self.config.window :], *later])
        return [self.views[i] for i in later if not self.views[i].has_depth]


def _unit(first: MapView) -> float:
    """Median depth of a keyframe where it is confident, map units."""
    depth = first.dense.arrays()
    known = depth.confidence > 0
    confident = depth.depth[known & (depth.confidence >= np.median(depth.confidence))]
    return float(np.median(confident)) if known.any() else first.typical_depth
