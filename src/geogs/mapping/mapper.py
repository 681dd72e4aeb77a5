"""The back end: keyframe depths in, a trained disk map and refined poses out."""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from operator import attrgetter

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.config import DepthSensorConfig, MappingConfig
from geogs.depth.base import Progress, silent
from geogs.depth.select import depth_engine
from geogs.errors import InputError
from geogs.mapping.cameras import MapCameras
from geogs.mapping.keyframe_depths import CANDIDATES, KeyframeDepths
from geogs.mapping.levelling import light_of
from geogs.mapping.map_frame import WORLD, MapFrame
from geogs.mapping.map_update import MapUpdate, plan_update, witness
from geogs.mapping.near_views import NearViews
from geogs.mapping.rendered import (
    MapRenderer,
    SurfaceRules,
    rendered_keyframe,
    rendered_surface,
    searched_keyframe,
    shown_depth,
)
from geogs.mapping.state import MapperState, RandomState, TrainedState, ViewState
from geogs.mapping.stored_renders import StoredRender, stored_render
from geogs.mapping.training.base import Batch, MapTrainer, TrainingPlace, draw_partners
from geogs.mapping.training.select import map_trainer
from geogs.mapping.view import MapView
from geogs.mapping.view_pool import ViewPool
from geogs.mapping.window import choose_partners, draw_views
from geogs.on_demand import OnDemand
from geogs.splat.density import (
    candidate_pixels,
    split,
    unexplained,
    worth_keeping,
    worth_splitting,
)
from geogs.splat.init import new_disks
from geogs.splat.map import DiskParameters, GaussianMap
from geogs.splat.optimizer import MapOptimizer
from geogs.splat.render import render
from geogs.types import MapSnapshot, PoseCorrection, RenderedKeyframe
from geogs.world.archive import Archive
from geogs.world.keyframes import KeyframeTable

# Nearest keyframes that vote on a keyframe's disks; others are too far away to know better.
_VOTERS = 96
# Keyframes that say how the map moves with a correction, at most: neighbours say the same.
_WITNESSES = 256
SEARCHED = 0.4
"""Part of the time of a search of all depths and the training after it that the search takes."""
# Steps of the final training between two reports of progress, at least.
_REPORTED_STEPS = 20
# Steps from which the time of one is judged, if they take so many seconds; else so often again.
_REHEARSED_STEPS, _TELLING_SECONDS, _REHEARSALS = 16, 0.2, 8


def never_pause() -> None:
    """Nobody is let go first."""


class Mapper:
    """Grows and trains the map keyframe by keyframe.

    ``observe`` takes settled keyframes as images to match with; ``map_keyframe`` makes one of them
    part of the map. Poses are those of the store at any time. Everything is in the tracker's units;
    ``unit`` is the median depth of the first keyframe, by which settings that are lengths are
    scaled.
    """

    def __init__(
        self,
        keyframes: KeyframeTable,
        config: MappingConfig,
        seed: int = 0,
        sensor: DepthSensorConfig | None = None,
    ):
        self.config = config
        self.keyframes = keyframes
        self.cameras = MapCameras.of(keyframes.grid.camera, config)
        self.map = GaussianMap.empty(keyframes.grid.device)
        engine = depth_engine(
            self.map.device,
            self.cameras.render,
            self.cameras.working,
            config.depth,
            keyframes.resident,
        )
        self.views: dict[int, MapView] = {}
        self.pool = ViewPool(self.cameras, config.loss, self.map.device, keyframes.resident)
        self._depths = KeyframeDepths(engine, self.views, self.pool, sensor)
        self.mapped: list[int] = []
        self._near = NearViews(self.views)
        self.trained = TrainingPlace()
        """How far the training over all keyframes is, at each report of its progress."""
        self._given: frozenset[int] = frozenset()
        """Keyframes of a saved map."""
        self._order: list[int] = []
        """Of the keyframes that it comes to next, by their places among those mapped."""
        self._trainer: MapTrainer | None = None
        self._seconds_to_prune = 0.0
        self.pause: Callable[[], None] = never_pause
        """Called between the parts of the work on a keyframe, where others may go first."""
        self._random = np.random.default_rng(seed)
        self._torch_random = torch.Generator().manual_seed(seed)

    @property
    def keyframe_ids(self) -> list[int]:
        """Keyframes observed so far, in order."""
        return list(self.views)

    def observe(self, keyframe_id: int, mask: Bool[np.ndarray, "h w"] | None = None) -> None:
        """A settled keyframe, from now on available for matching.

        Outside a mask, of the size of its image, it has no depth.
        """
        keyframe = self.keyframes[keyframe_id]
        self.pool.add(keyframe, mask)
        view = MapView(keyframe, self.pool)
        self.views[keyframe_id] = view
        self._depths.engine.observe(view.depth_view)

    def take_over(
        self, disks: MapSnapshot, masks: Mapping[int, Bool[np.ndarray, "h w"]], ids: Sequence[int]
    ) -> None:
        """Begin with a saved map, and the keyframes of the store that it was made from.

        Their depths are what the map shows from them, inside ``masks``, and are not searched again.
        """
        parameters, rules = DiskParameters.of(disks), SurfaceRules.of(self.config)
        for i in ids:
            self.observe(i, masks.get(i))
            view = self.views[i]
            shown = rendered_surface(parameters, self.cameras.render, view.T_cw, rules, view.mask)
            self.pool.set_depth(i, shown_depth(shown))
        self.mapped, self._given = [*ids], frozenset(ids)
        self.choose_partners()
        self._training().optimizer.append(parameters, ids[0])
        self.map.seen.fill_(1)

    def move_to(self, keyframes: KeyframeTable) -> None:
        """Go on with the keyframes of another store, which are what its own are."""
        self.keyframes = keyframes
        self.pool.move_to(keyframes)
        for i, view in self.views.items():
            view.keyframe = keyframes[i]

    def state(self) -> MapperState:
        """What a checkpoint holds."""
        trainer, training = self._trainer, None
        if trainer is not None:
            training = TrainedState(trainer.unit, trainer.optimizer.state())
        return MapperState(
            {i: ViewState(view.partners, view.search) for i, view in self.views.items()},
            self.pool.state(), self.mapped, training, self.trained, self._order,
            RandomState.of(self._random, self._torch_random),
        )  # fmt: skip

    def load(self, state: MapperState) -> None:
        """Give a mapper without a map the state of another, whose keyframes are in the store.

        It may have observed these keyframes already.

        Raises:
            InputError: the state is incomplete, or of other keyframes.
        """
        if not {*state.views, *state.mapped} <= state.pool.maps.keys():
            raise InputError("a view of the map is missing")
        if not all(i in self.keyframes for i in state.pool.maps):
            raise InputError("a keyframe of the map is missing")
        if not all(0 <= n < len(state.mapped) for n in state.order):
            raise InputError("the place in the training is none")
        self.pool.load(state.pool, {i: self.keyframes[i] for i in state.pool.maps})
        for i, saved in state.views.items():
            self.views[i] = MapView(self.keyframes[i], self.pool, saved.partners, saved.search)
        self.mapped, self.trained, self._order = state.mapped, state.place, state.order
        if state.training is not None:
            self._trainer = self._new_trainer(state.training.unit)
            self._trainer.optimizer.load(state.training.disks)
        state.random.restore(self._random, self._torch_random)

    def map_keyframe(self, keyframe_id: int) -> None:
        """Give a keyframe its depth, carve and grow the map with it, train the window."""
        view = self.views[keyframe_id]
        trained = [*self.mapped, keyframe_id]
        drawn = draw_views(trained, self.config.iterations, self.config, self._random)
        # Old ones have to be read from a file; meanwhile the depth is searched.
        self.pool.read_ahead({i for ids in drawn for i in ids if i != keyframe_id})
        self._estimate_ahead(keyframe_id)
        self.pause()
        self._depths.check([view])
        self.pause()
        self.mapped.append(keyframe_id)
        self._choose_partners(view)
        self._level(view)
        trainer = self._training()
        self._carve([view, *self._depths.near(view)])
        self.pause()
        self._insert(view, self.config.disk.insert_confidence)
        if len(self.mapped) > self.config.window:
            left = self.views[self.mapped[-1 - self.config.window]]
            self._insert(left, self.config.disk.fill_confidence)
        batches = [self._batch(ids) for ids in drawn]
        seen = {v.id for batch in batches for own, others in batch for v in (own, *others)}
        self.pool.read_ahead(seen)
        self.pause()
        trainer.train(batches)
        self.pause()
        if len(self.mapped) % self.config.disk.carve_every == 0:
            self._prune_by(self._mapped_around(view, _VOTERS))

    def refine_poses(self, active: Sequence[int]) -> None:
        """Give the active keyframes poses that agree better with the map; the earliest stays."""
        active = [i for i in active if i not in self._given]
        views = [self.views[i] for i in active if i in self.views and self.views[i].has_depth]
        if len(views) < 2 or len(self.map) == 0:
            return
        poses = self._training().refine_poses(views, self.views, self.config)
        for i, T_cw in poses.items():
            self.keyframes[i].T_cw = T_cw

    def refine_all_poses(self) -> None:
        """The same for all mapped keyframes, in windows that overlap by half, earliest first."""
        step = max(self.config.window // 2, 1)
        for start in range(0, max(len(self.mapped) - step, 1), step):
            self.refine_poses(self.mapped[start : start + 2 * step])

    def correct(self, correction: PoseCorrection) -> MapUpdate:
        """Move the map with a global correction that the keyframes have taken over."""
        views = [v for v in self.views.values() if v.has_depth]
        views = views[:: 1 + len(views) // _WITNESSES]
        update = plan_update(
            self.map.position,
            self.map.keyframe_id,
            correction,
            self.config.ablation.map_update,
            (witness(v, correction) for v in views),
        )
        if len(self.map):
            self._training().optimizer.transform(update.transform)
            self._training().forget_renders(self.views.values())
        return update

    def refine(self, progress: Progress = silent) -> None:
        """Train over all keyframes with the final poses, after searching their depths again."""
        if not self.mapped or self.config.final_iterations == 0:
            return
        views = [self.views[i] for i in self.mapped if i not in self._given]
        if self.config.final_depth and views:
            self._depths.estimate(views, lambda fraction: progress(SEARCHED * fraction))
            self.check_depths()
        self.grow()
        start = SEARCHED if self.config.final_depth else 0.0
        steps = self.config.final_steps(self.keyframes.grid.on_gpu)
        self.train(steps, lambda fraction: progress(start + (1 - start) * fraction))

    def search_depths(self, keyframe_ids: list[int]) -> None:
        """Depths of some keyframes from their images; they are mapped then."""
        self._depths.estimate([self.views[i] for i in keyframe_ids])
        self.mapped = sorted({*self.mapped, *keyframe_ids})

    def check_depths(self) -> None:
        """Let the depths of all mapped keyframes revise each other, once per search."""
        self._depths.check([self.views[i] for i in self.mapped if i not in self._given])

    def grow(self) -> None:
        """Carve the map with all mapped keyframes, and add what their depths show beyond it."""
        self.choose_partners()
        self.prune()
        for i in self.mapped:
            self._insert(self.views[i], self.config.disk.insert_confidence)

    def choose_partners(self) -> None:
        """Photometric partners of all mapped keyframes, which are brought into the same light."""
        for i in self.mapped:
            self._choose_partners(self.views[i])
        for i in self.mapped:
            self._level(self.views[i])

    def train(
        self,
        steps: int,
        progress: Progress = silent,
        until: float | None = None,
        goes_on: bool = False,
    ) -> None:
        """Single-view steps over all mapped keyframes; disks that none has seen go.

        Fewer steps where they would last beyond ``until``, a time of ``time.perf_counter``. A
        training that was cut off ``goes_on`` from where it was.
        """
        if not goes_on:
            self.trained, self._order = TrainingPlace(), []
        self._train_all([self.views[i] for i in self.mapped], steps, progress, until)
        self.prune()
        self._training().optimizer.keep(self.map.seen > 0)

    def seconds_per_step(self) -> float:
        """What a training step takes, from some of them at full rate: from more where these are
        quick."""
        self._rehearse(2)  # makes ready what is needed but once
        seconds = self._rehearse(_REHEARSED_STEPS)
        if seconds > _TELLING_SECONDS:
            return seconds / _REHEARSED_STEPS
        more = [self._rehearse(_REHEARSED_STEPS) for _ in range(_REHEARSALS)]
        return float(np.median(more)) / _REHEARSED_STEPS

    def _rehearse(self, steps: int) -> float:
        """Seconds that so many training steps take."""
        start = time.perf_counter()
        drawn = self._random.choice(self.mapped, steps)
        self._training().train([self._batch([int(i)]) for i in drawn])
        float(self.map.position.detach().sum())  # waits for a GPU
        return time.perf_counter() - start

    def prune(self) -> None:
        """Drop transparent and broken disks, and those that the keyframes see in free space."""
        self._prune_by([self.views[i] for i in self.mapped])

    def _prune_by(self, voters: list[MapView]) -> None:
        """The same where only some keyframes have a say, as the votes of others do not change."""
        self._training().optimizer.keep(worth_keeping(self.map, self.config.disk))
        self._carve(voters)

    @torch.no_grad()
    def renders(
        self, disks: MapSnapshot | None = None, of: Sequence[int] | None = None
    ) -> Sequence[RenderedKeyframe]:
        """The map, or other disks in its frame, seen from every mapped keyframe, or from some.

        Rendered now, from a snapshot, so that disks that were written show the same; of a long
        video most are read from a temporary file when they are asked for.

        Raises:
            OutputError: the disk is full, or cannot be written.
        """
        parameters = DiskParameters.of(self.map.snapshot() if disks is None else disks)
        camera, archive, stored = self.cameras.render, Archive(), []
        rules = SurfaceRules.of(self.config)
        for view in (self.views[i] for i in (self.mapped if of is None else of)):
            render = rendered_keyframe(view, parameters, camera, rules)
            stored.append(
                stored_render(render, view.keyframe.table.arrays.pieces["image"][view.id], archive)
            )
        return OnDemand(stored, StoredRender.load)

    def renderer(self, frame: MapFrame = WORLD) -> MapRenderer:
        """What shows the map as it is now from anywhere, asked in the coordinates of a world."""
        rules = SurfaceRules.of(self.config)
        return MapRenderer(self.map.snapshot(), frame, self.cameras.render, rules)

    def depth_maps(self, of: Sequence[int] | None = None) -> Sequence[RenderedKeyframe]:
        """The dense depths of the mapped keyframes, or of some, weighted by confidence: no disk is
        in them.

        Each is read when it is asked for, as it is at that time.
        """
        views = [self.views[i] for i in (self.mapped if of is None else of)]
        return OnDemand(views, partial(searched_keyframe, camera=self.cameras.render))

    @property
    def optimizer(self) -> MapOptimizer:
        """What changes the map, once a keyframe is mapped."""
        return self._training().optimizer

    @property
    def unit(self) -> float:
        """Median depth of the first keyframe, map units."""
        return self._training().unit

    def _training(self) -> MapTrainer:
        if self._trainer is None:
            first = self.views[self.mapped[0]]
            depth = first.dense.arrays()
            known = depth.confidence > 0
            sure = depth.depth[known & (depth.confidence >= np.median(depth.confidence))]
            unit = float(np.median(sure)) if known.any() else first.typical_depth
            self._trainer = self._new_trainer(unit)
        return self._trainer

    def _new_trainer(self, unit: float) -> MapTrainer:
        return map_trainer(self.map, self.cameras, self.config, unit, self.keyframes.resident)

    def _estimate_ahead(self, keyframe_id: int) -> None:
        """Depths of the keyframe and of its next ones, which then check each other.

        The tracker's own depths are taken as they are now, of the window around, too.
        """
        later = [i for i in self.views if i >= keyframe_id][: 1 + self.config.lag // 2]
        wanted = [i for i in later if not self.views[i].has_depth]
        if self.config.depth.engine == "tracker":
            wanted = [*self.mapped[-self.config.window :], *later]
        self._depths.estimate([self.views[i] for i in wanted], lambda _: self.pause())

    def _mapped_around(self, view: MapView, count: int) -> list[MapView]:
        return self._near.around(view, self.mapped, count)

    def _choose_partners(self, view: MapView) -> None:
        """Photometric partners of a view; it becomes a candidate for those before it."""
        photo = self.config.photo
        mapped = self._mapped_around(view, CANDIDATES)
        view.partners = choose_partners(view, mapped, view.typical_depth, photo)
        for i in view.partners:
            other = self.views[i]
            pool = [self.views[j] for j in {*other.partners, view.id} if j in self.views]
            other.partners = choose_partners(other, pool, other.typical_depth, photo)

    def _level(self, view: MapView) -> None:
        """Give a view's grey values the light of the partners that have it already."""
        if view.is_levelled or not self.config.photo.compensate_exposure:
            return
        known = [self.views[i] for i in view.partners if self.views[i].is_levelled]
        self.pool.set_light(view.id, light_of(view, known))

    def _batch(self, ids: list[int]) -> Batch:
        views = [self.views[i] for i in ids]
        return [(v, draw_partners(v, self.views, self.config, self._random)) for v in views]

    def _carve(self, views: list[MapView]) -> None:
        if len(self.map) and self.config.disk.carve:
            self._training().optimizer.keep(self._vote(self.map.position.detach(), views))

    def _vote(self, points: Float[Tensor, "n 3"], views: list[MapView]) -> Bool[Tensor, "n"]:
        known = [v for v in views if v.has_depth]
        # Read one after the other where they are not in memory.
        return self._depths.engine.keep(points, OnDemand(known, attrgetter("posed")))

    @torch.no_grad()
    def _insert(self, view: MapView, min_confidence: float) -> None:
        """Disks where the map does not explain a view's depth, by local planes."""
        disk, camera = self.config.disk, self.cameras.render
        depth, confidence = view.dense.depth, view.dense.confidence
        output = render(self.map, camera, view.T_cw)
        needed = unexplained(output, depth, confidence, disk) & (confidence >= min_confidence)
        v, u = candidate_pixels(camera.height, camera.width, disk.stride, self._torch_random)
        v, u = v.to(depth.device), u.to(depth.device)
        chosen = needed[v, u]
        v, u = v[chosen], u[chosen]
        z = depth[v, u]
        T_wc = view.T_wc.float().to(depth.device)
        rays = camera.rays(device=depth.device)[v, u]
        points = (rays * z[:, None]) @ T_wc[:3, :3].T + T_wc[:3, 3]
        if disk.carve:
            others = [v for v in self._mapped_around(view, _VOTERS) if v.id != view.id]
            kept = self._vote(points, others)
            points, z = points[kept], z[kept]
        if len(points) + len(self.map) < disk.neighbours or len(points) == 0:
            return
        footprint = disk.stride * z / camera.fx
        new = new_disks(
            points, T_wc[:3, 3], footprint, self.map.position.detach(), disk, self._torch_random,
            self.config.ablation.initialisation,
        )  # fmt: skip
        self._training().optimizer.append(new, view.id)

    def _train_all(
        self, views: list[MapView], total: int, progress: Progress, until: float | None
    ) -> None:
        """Single-view steps over all keyframes in random order, with falling learning rates.

        The rates fall with the steps or with the time, whichever is nearer to its end.
        """
        start = time.perf_counter() - self.trained.seconds
        trainer = self._training()
        fills, prunes = {total // 3, 2 * total // 3}, max(total // 4, 1)
        splits = {int(total * part) for part in self.config.disk.split_times}
        rounds = self.config.final_pose_rounds
        poses = {total * (n + 1) // (rounds + 1) for n in range(rounds)}
        events = fills | splits | poses | set(range(prunes, total, prunes))
        # Where time is short steps are few and slow, so that it is looked at the clock more often.
        at_once = _REPORTED_STEPS if until is None else min(_REPORTED_STEPS, max(total // 50, 1))
        stops = sorted(events | set(range(at_once, total, at_once)) | {total})
        done = self.trained.steps
        for stop in (stop for stop in stops if stop > done):
            late = 0.0
            if until is not None:
                end = until - self._seconds_to_prune
                late = (time.perf_counter() - start) / max(end - start, 1e-9)
            if late >= 1.0:
                break
            batches = []
            for _ in range(done, stop):
                if not self._order:
                    self._order = self._random.permutation(len(views)).tolist()
                batches.append(self._batch([views[self._order.pop()].id]))
            shares = [max(step / total, late) for step in range(done + 1, stop + 1)]
            rates = [self.config.lr_final**share for share in shares]
            trainer.train(batches, rates)
            done = stop
            seen = self._trained_lately(views, total)
            if done % prunes == 0 and done < total:
                begin = time.perf_counter()
                self._prune_by(seen)
                self._seconds_to_prune = time.perf_counter() - begin
            if done in splits:
                self._split()
            if done in poses:
                self.refine_all_poses()
            if done in fills:
                for view in seen:
                    self._insert(view, self.config.disk.fill_confidence)
            self.trained = TrainingPlace(done, total, time.perf_counter() - start)
            progress(done / total)

    def _trained_lately(self, views: list[MapView], total: int) -> list[MapView]:
        """The views around which the map may have changed in a training of so many steps: all, but
        of more views than steps those that have been trained."""
        if len(views) <= total:
            return views
        left = set(self._order)
        return [view for n, view in enumerate(views) if n not in left]

    def _split(self) -> None:
        """Split the disks that are pulled hardest; those below a pixel are small enough."""
        disk, optimizer = self.config.disk, self._training().optimizer
        if disk.split_ratio == 0:
            return
        pixel = self.unit / self.cameras.render.fx
        chosen = worth_splitting(
            self.map, optimizer.position_gradient, disk.split_ratio, disk.split_pixels * pixel
        )
        ids = self.map.keyframe_id[chosen]
        optimizer.replace(chosen, split(self.map, chosen), torch.cat([ids, ids]))
