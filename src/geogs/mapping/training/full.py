"""The long training over all keyframes at the end."""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int64

from geogs.config import MappingConfig
from geogs.depth.depth_engine import Progress
from geogs.mapping.disk_growth import DiskGrowth
from geogs.mapping.keyframe_views import KeyframeViews, MapView
from geogs.mapping.training.map_trainer import draw_batch
from geogs.world.map import MapTable, TrainingPlace

if TYPE_CHECKING:
    from geogs.mapping.training.trainer_choice import MapTrainer

# Most views that are shuffled all together, about as many as stay in memory; else the block size.
_SHUFFLED, _BLOCK = 128, 32
# Most steps between two reports of progress.
_REPORTED_STEPS = 20
# Number of timed steps; seconds below which they are repeated, and how often.
_REHEARSED_STEPS, _ENOUGH_SECONDS, _REHEARSALS = 16, 0.2, 8


class FullTraining:
    """Single-view steps over all mapped keyframes in random order, with falling learning rates.

    The first are at half the resolution if the trainer has a coarse part. Meanwhile the map is
    pruned and filled.
    """

    def __init__(
        self,
        table: MapTable,
        views: KeyframeViews,
        trainer: "MapTrainer",
        growth: DiskGrowth,
        config: MappingConfig,
    ) -> None:
        self._table = table
        self._views = views
        self._trainer = trainer
        self._growth = growth
        self._config = config
        self._mapped = [views[i] for i in table.mapped]

    def run(self, total: int, progress: Progress, until: float | None) -> None:
        """Continue from the table's ``place`` to ``total`` steps, or to a time of
        ``time.perf_counter``; rates fall with the steps or the time, whichever is nearer its end.
        """
        table = self._table
        config = self._config
        begin = time.perf_counter() - table.place.seconds
        seconds_to_prune = 0.0
        prunes = max(total // 4, 1)
        fills = {total // 3, 2 * total // 3} if config.ablation.start == "depths" else set()
        coarse = int(self._trainer.coarse_part * total)
        events = fills | set(range(prunes, total, prunes)) | {coarse} - {0}
        # Where time is short, steps are few and slow, and the clock is read more often.
        at_once = _REPORTED_STEPS if until is None else min(_REPORTED_STEPS, max(total // 50, 1))
        stops = sorted(events | set(range(at_once, total, at_once)) | {total})
        done = table.place.steps
        for stop in (stop for stop in stops if stop > done):
            late = 0.0
            if until is not None:
                end = until - seconds_to_prune
                late = (time.perf_counter() - begin) / max(end - begin, 1e-9)
            if late >= 1.0:
                break
            batches = [self._draw() for _ in range(done, stop)]
            fractions = [max(step / total, late) for step in range(done + 1, stop + 1)]
            is_coarse = stop <= coarse and late <= self._trainer.coarse_part
            self._trainer.train(batches, [config.lr_final**f for f in fractions], is_coarse)
            done = stop
            seen = self._trained_lately(total)
            if done % prunes == 0 and done < total:
                start = time.perf_counter()
                self._growth.prune(seen)
                seconds_to_prune = time.perf_counter() - start
            if done in fills:
                for view in seen:
                    self._growth.insert(view, config.disk.fill_confidence)
            table.place = TrainingPlace(done, total, time.perf_counter() - begin)
            progress(done / total)

    def _draw(self) -> list[tuple[MapView, list[MapView]]]:
        """Draw the next view in random order; each comes once before any comes again."""
        table = self._table
        if not table.order:
            table.order = random_order(len(self._mapped), table.random.of_numpy).tolist()
        id = self._mapped[table.order.pop()].id
        return draw_batch([id], self._views, self._config, table.random.of_numpy)

    def _trained_lately(self, total: int) -> list[MapView]:
        """The views around which the map may have changed: all, or if there are more than steps,
        those that have been trained."""
        if len(self._mapped) <= total:
            return self._mapped
        left = set(self._table.order)
        return [view for n, view in enumerate(self._mapped) if n not in left]


def random_order(count: int, random: np.random.Generator) -> Int64[np.ndarray, "n"]:
    """The numbers below ``count``, shuffled; for a long video, in blocks of consecutive keyframes.

    The blocks come in random order, shuffled within. Views of a block have most partners in common,
    so few views are read from the file.
    """
    if count <= _SHUFFLED:
        return random.permutation(count)
    blocks = np.split(np.arange(count), np.arange(random.integers(1, _BLOCK + 1), count, _BLOCK))
    return np.concatenate([random.permutation(blocks[i]) for i in random.permutation(len(blocks))])


def seconds_per_step(
    table: MapTable, views: KeyframeViews, trainer: "MapTrainer", config: MappingConfig
) -> float:
    """Seconds for a training step, measured on some at full rate; on more if these are quick."""

    def rehearse(steps: int) -> float:
        start = time.perf_counter()
        drawn: Sequence[int] = table.random.of_numpy.choice(table.mapped, steps).tolist()
        trainer.train([draw_batch([i], views, config, table.random.of_numpy) for i in drawn])
        float(table.disks.position.detach().sum())  # waits for a GPU
        return time.perf_counter() - start

    rehearse(2)  # warms up
    seconds = rehearse(_REHEARSED_STEPS)
    if seconds > _ENOUGH_SECONDS:
        return seconds / _REHEARSED_STEPS
    more = [rehearse(_REHEARSED_STEPS) for _ in range(_REHEARSALS)]
    return float(np.median(more)) / _REHEARSED_STEPS
