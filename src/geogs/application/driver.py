"""Common flow of the commands that make a result, from the source to the files."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from geogs.application.checkpoints.checkpoint import Checkpoint, has_checkpoint
from geogs.application.interrupt import Stop
from geogs.application.machine.compilation import Compilation
from geogs.application.machine.device import REMEDY, gpu_errors_in_a_sentence
from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.output_folder import claimed, free_folder, is_complete
from geogs.application.results.result import Result
from geogs.application.results.surfaces import write_depth_mesh
from geogs.application.results.write import write_files
from geogs.application.run_settings import ReconstructSettings, RunSettings
from geogs.application.viewer.observer import RunObserver
from geogs.errors import DeviceError, OutputError
from geogs.guard.replacement import replaced
from geogs.io.sources.frame_source import Source
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.stopwatch import Stopwatch

if TYPE_CHECKING:
    from geogs.application.results.mapped_scene import MappedScene
    from geogs.reconstruction import Reconstruction


class Outcome(Enum):
    """How the work ended."""

    FINISHED = auto()
    STOPPED = auto()
    """Ended by a request; there is something to keep."""
    MEMORY_FULL = auto()
    """The memory of a GPU was full; there is something to keep."""


class Work(ABC):
    """The part that differs between commands: poses and a map from a source."""

    scene: "MappedScene"
    """The scene that is written, once the work has ended."""
    source: Source | PosedSource
    """The source of the work."""

    @property
    def stopwatch(self) -> Stopwatch:
        """Seconds of its stages."""
        return self.scene.stopwatch

    @property
    def way_on(self) -> str:
        """A sentence on how to resume from a checkpoint; empty where it makes none."""
        return ""

    def state(self) -> object | None:
        """The record for a checkpoint; none while there is nothing to resume from."""
        return None

    @abstractmethod
    def complete(self, driver: "Driver", checkpoint: Checkpoint, new: Path) -> Outcome:
        """Do all work up to the trained map, with checkpoints on the way.

        Additional files of the result that are known before its end go to ``new``.
        Raises KeyboardInterrupt where it was stopped before there was anything to keep.
        """

    def write_more(self, driver: "Driver", new: Path) -> None:  # noqa: B027  # most have none
        """Write additional files into the new folder of the result."""


class _FormerStays(Exception):
    """An incomplete result was written into another folder, as a complete one is there."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.folder = folder


@dataclass(frozen=True)
class Driver:
    """Device, output, progress, observer and stop request of a command."""

    settings: RunSettings | ReconstructSettings
    output: Path
    device: torch.device
    progress: RunProgress
    stop: Stop
    observer: RunObserver | None = None
    kernels: Compilation = field(default_factory=Compilation)
    """Background compilation of kernels for the CPU."""

    def report(self, stage: str, fraction: float) -> None:
        """Report progress of a stage; raises KeyboardInterrupt after a request to stop."""
        self.progress.stage(stage, fraction)
        self.stop.check()

    def stop_early(self, why: str = "Stopping early") -> None:
        """Report that the work so far will be kept."""
        self.progress.write(f"{why}; keeping what there is. Press Ctrl-C again to quit.")

    def map_known(
        self, scene: "Reconstruction", work: Callable[[], None], checkpoint: Checkpoint
    ) -> Outcome:
        """Map a scene of known poses by ``work``; where it is stopped, keep the map so far.

        Raises KeyboardInterrupt where it is stopped before there is any.
        """

        def compiled() -> None:
            self.kernels.wait(self.report)
            work()

        if self.stop.lets_finish(compiled):
            return Outcome.FINISHED
        if not len(scene.snapshot()):
            raise KeyboardInterrupt
        self.stop_early()
        checkpoint.write()
        return Outcome.STOPPED

    def complete(self, work: Work) -> Result:
        """Do the work to its end, or until it is stopped, then write the files of the result.

        Raises:
            KeyboardInterrupt: it was stopped before there was anything to keep, or twice.
            OutputError: a file cannot be written.
            DeviceError: the memory of the device was full; results so far are written, if any.
        """
        settings = self.settings
        output = self.output
        progress = self.progress
        every = settings.checkpoint_every if work.way_on else 0.0
        checkpoint = Checkpoint(output, every, work.state, progress, work.stopwatch)

        def way_on() -> str:
            return f" {work.way_on}" if work.way_on and has_checkpoint(output) else ""

        with gpu_errors_in_a_sentence(way_on), self.stop:
            try:
                with replaced(output, "result") as new:
                    outcome = work.complete(self, checkpoint, new)
                    finished = outcome is Outcome.FINISHED
                    scene = work.scene
                    self.kernels.wait(progress.stage)
                    can_resume = not finished and checkpoint.is_complete
                    result = Result(scene, work.source, not finished, progress, output, can_resume)
                    write_more = partial(self._write_more, work, new)
                    write_files(new, result, write_more, settings.keyframe_images)
                    if is_complete(output) and not is_complete(new):
                        raise _FormerStays(self._written_beside(new))
            except _FormerStays as kept:
                result = replace(result, folder=kept.folder, can_resume=False)
                progress.write(way_on().strip())
            except OutputError as error:
                raise OutputError(f"{error}{way_on()}") from error
            if self.observer is not None:
                self.observer.result(result)
        if outcome is Outcome.MEMORY_FULL:
            raise DeviceError(
                f"The memory of the GPU was full after {scene.frames} frames, whose results are in "
                f"{result.folder}/; {REMEDY}.{way_on()}"
            )
        if finished and work.way_on:
            checkpoint.remove()
        return result

    def _written_beside(self, new: Path) -> Path:
        """Put the files of an incomplete result into a folder of their own. Returns the folder."""
        with claimed(free_folder(self.output)) as other, replaced(other, "result") as files:
            for path in new.iterdir():
                path.rename(files / path.name)
        self.progress.write(
            f"This incomplete result goes to {other}; the complete one in {self.output} stays."
        )
        return other

    def _write_more(self, work: Work, new: Path) -> None:
        work.write_more(self, new)
        if self.settings.depth_mesh:
            write_depth_mesh(new, work.scene, self.progress)
