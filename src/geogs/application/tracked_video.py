"""A video whose frames are tracked one by one, mapped, with checkpoints on the way."""

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import torch

from geogs.application.calibrate import lens_sentence
from geogs.application.checkpoints.checkpoint import Checkpoint
from geogs.application.checkpoints.run_state import RunMetadata, RunState, run_state
from geogs.application.driver import Driver, Outcome
from geogs.application.results.surfaces import write_stage
from geogs.application.scale.known_length import make_metric, scale_source
from geogs.io.sources.frame_source import Source
from geogs.mapping.mapper import SEARCHED
from geogs.slam import Slam
from geogs.stopwatch import Stopwatch
from geogs.types import Frame

MIN_PREVIEW_KEYFRAMES = 20
"""Least number of keyframes for a preview: map and mesh take long on a CPU then."""


@dataclass
class TrackedVideo:
    """A video whose frames are tracked one by one, by a prepared system."""

    scene: Slam
    source: Source
    """The calibrated source."""
    frames: Generator[Frame, None, None]
    """Remaining frames."""
    metadata: RunMetadata
    output: Path

    @property
    def way_on(self) -> str:
        """The command that resumes from the last checkpoint."""
        on_cpu = ", with --device cpu on the CPU" if self.metadata.device != "cpu" else ""
        return f"geogs run --resume {self.output} continues from the last checkpoint{on_cpu}."

    def state(self) -> RunState | None:
        """The checkpoint record; none where the run cannot be resumed."""
        if self.metadata.settings.map is not None or self.source.is_live:
            return None
        return run_state(self.metadata, self.scene, self.source)

    def locate(self, driver: Driver, checkpoint: Checkpoint, new: Path) -> Outcome:
        """Estimate poses: track the remaining frames, then adjust all keyframes.

        Raises TrackingLost if no frame could be tracked.
        """
        slam = self.scene
        source = self.source
        progress = driver.progress
        if not slam.world.maps_at_end:
            driver.kernels.wait(progress.stage)
        progress.expect(source.length)
        with closing(self.frames):
            outcome = self._track(driver, checkpoint)
        if outcome is not Outcome.MEMORY_FULL and outcome is not Outcome.FINISHED:
            checkpoint.write()
        slam.end_stream()
        if outcome is Outcome.FINISHED:
            checkpoint.write()
        self._write_stage("online", driver, new)
        return _finished(driver, outcome, lambda: self._adjust(driver, new))

    def map(self, driver: Driver, outcome: Outcome) -> Outcome:
        """Make the map after :meth:`locate` ended with ``outcome``; if either is interrupted, a map
        in little time."""
        slam = self.scene
        was_cut = outcome is not Outcome.FINISHED
        if outcome is Outcome.FINISHED and slam.world.maps_at_end and not driver.kernels.is_working:
            self._write_preview(driver)
        outcome = _finished(driver, outcome, lambda: self._refine(driver))
        if was_cut or outcome is Outcome.STOPPED:
            briefly = partial(slam.refine, driver.progress.stage, seconds=40.0)
            _finished(driver, Outcome.FINISHED, briefly)
        scale = scale_source(self.metadata.settings.scale_from)
        make_metric(slam, self.source, scale, driver.progress)
        return outcome

    def _track(self, driver: Driver, checkpoint: Checkpoint) -> Outcome:
        """Track all frames, until a request to stop."""
        stop = driver.stop
        try:
            if self.scene.world.is_ended:
                next(self.frames, None)  # only for the source's messages at its end
            else:
                self._track_each(driver, checkpoint)
        except torch.cuda.OutOfMemoryError:
            torch.cuda.empty_cache()
            driver.stop_early("The GPU has no memory left")
            return Outcome.MEMORY_FULL
        if self.source.is_live and stop.requested:  # the usual end of a live source
            stop.requested = False
            driver.progress.write("Stopping; finishing the map. Press Ctrl-C to stop that, too.")
        if not stop.requested:
            return Outcome.FINISHED
        driver.stop_early()
        return Outcome.STOPPED

    def _track_each(self, driver: Driver, checkpoint: Checkpoint) -> None:
        slam = self.scene
        dropped = 0
        for frame in _timed(self.frames, slam.stopwatch):
            if self.source.dropped > dropped:
                dropped = self.source.dropped
                driver.progress.dropped(dropped)
            status = slam.process(frame)
            driver.progress.frame(status)
            if driver.observer is not None:
                driver.observer.frame(frame, status, slam)
            if driver.stop.requested:
                return
            checkpoint.write_if_due()

    def _refine(self, driver: Driver) -> None:
        """Make the map; the kernels of its depths are compiled first."""
        kernels = driver.kernels
        kernels.wait(driver.report, "search")

        def report(stage: str, fraction: float) -> None:
            driver.report(stage, fraction)
            if fraction >= SEARCHED:
                kernels.wait(driver.report, "train")

        self.scene.refine(report)

    def _write_preview(self, driver: Driver) -> None:
        """Write a rough mesh if the final one takes long."""
        slam = self.scene
        is_short = len(slam.segments.main.segment.ids) < MIN_PREVIEW_KEYFRAMES
        if is_short or slam.world.keyframes.grid.on_gpu:  # there the map is made in seconds
            return
        from geogs.application.results.surfaces import PREVIEW, write_preview

        with slam.stopwatch("preview"):
            is_there = write_preview(driver.output, slam)
        if is_there:
            driver.progress.write(f"A rough preview of the mesh is in {driver.output / PREVIEW}.")

    def _adjust(self, driver: Driver, new: Path) -> None:
        self.scene.adjust(driver.report)
        if (lens := self.scene.lens) is not None:
            before = self.source
            self.source = self.source.with_lens(lens)
            driver.progress.write(lens_sentence(before.calibration, lens, self.source.calibration))
        if self.scene.will_refine:
            self._write_stage("adjusted", driver, new)

    def _write_stage(self, name: Literal["online", "adjusted"], driver: Driver, new: Path) -> None:
        """Write intermediate results, if they are requested and there is a map."""
        if self.metadata.settings.online_results and not self.scene.world.maps_at_end:
            write_stage(new, self.scene, driver.progress, name)


def _timed(frames: Iterator[Frame], stopwatch: Stopwatch) -> Iterator[Frame]:
    """The frames; waiting for them is a stage, too."""
    while True:
        with stopwatch("reading"):
            frame = next(frames, None)
        if frame is None:
            return
        yield frame


def _finished(driver: Driver, outcome: Outcome, stage: Callable[[], object]) -> Outcome:
    """Do a final stage, unless work was cut short before. Returns the outcome.

    If the GPU's memory is full, the results so far are kept.
    """
    if outcome is not Outcome.FINISHED:
        return outcome
    try:
        return outcome if driver.stop.lets_finish(stage) else Outcome.STOPPED
    except torch.cuda.OutOfMemoryError:
        torch.cuda.empty_cache()
        driver.progress.write(
            "The GPU has no memory left for the final stages; keeping what there is."
        )
        return Outcome.MEMORY_FULL
