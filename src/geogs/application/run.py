"""A run, from the paths of its videos to the files of its result; or on from a checkpoint."""

from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch

from geogs.application.calibrate import self_calibrated, with_shutter_found
from geogs.application.checkpoints.checkpoint import has_checkpoint
from geogs.application.checkpoints.run_state import RunCheckpoint, RunFacts, SavedRun, frames_after
from geogs.application.forecast import RunForecast
from geogs.application.interrupt import Stop
from geogs.application.machine.device import REMEDY, compiled_kernels, full_memory_in_a_sentence
from geogs.application.priors import open_prior
from geogs.application.progress import RunProgress
from geogs.application.results.output_folder import free_folder, only_writer
from geogs.application.results.result import Result, Written
from geogs.application.results.saved_result import SavedResult, load_result
from geogs.application.results.surfaces import write_depth_mesh, write_stage
from geogs.application.results.write import write_results
from geogs.application.scale.apply import check_scale_source, make_metric
from geogs.application.scale.source import scale_source
from geogs.application.settings import RunSettings
from geogs.application.viewer.observer import RunObserver
from geogs.config import Config, InputConfig
from geogs.config.idle import idle_settings
from geogs.errors import DeviceError, InputError
from geogs.gpu.installation import require_device
from geogs.io.sources.sniff import Stream, open_source
from geogs.io.writers.atomic import prepare_output_folder
from geogs.slam import Progress, Slam
from geogs.stopwatch import Stopwatch
from geogs.threads import on_one_torch_thread
from geogs.types import Frame

BRIEFLY = 40.0
"""Seconds for a map after an interruption, where there is none yet."""


@on_one_torch_thread
@full_memory_in_a_sentence()
def run(
    settings: RunSettings,
    progress: RunProgress | None = None,
    stop: Stop | None = None,
    observer: RunObserver | None = None,
) -> Written:
    """Open the sources, calibrate, track and map every frame, write the results.

    Raises:
        InputError: a source, a setting or a prior cannot be used.
        TrackingLost: no frame could be tracked.
        OutputError: a file cannot be written.
        DeviceError: the device cannot be used, or its memory was full; results so far are written.
    """
    progress, stop = progress or RunProgress(), stop or Stop()
    config, device = settings.config, require_device(settings.device)
    for sentence in idle_settings(config):
        progress.write(f"note: {sentence}")
    scale = scale_source(settings.scale_from)
    former = None if settings.map is None else load_result(settings.map, device)
    opened = open_source(
        settings.source, config.input if former is None else seen_by(former, config)
    )
    check_scale_source(scale, opened)
    wanted = settings.output or free_folder(Path("out") / opened.name, opened.fingerprint())
    if former is not None and wanted.resolve() == former.folder.resolve():
        raise InputError(f"{wanted} holds the map to go on with; give another folder by -o.")
    output = prepare_output_folder(wanted)
    with only_writer(output):
        return _run(settings, opened, former, output, device, progress, stop, observer)


def maps_at_the_end(settings: RunSettings, observer: RunObserver | None) -> bool:
    """Whether the map is made once, after the video; by default where nobody looks on."""
    is_shown = observer is not None or settings.online_results or settings.map is not None
    when = settings.config.mapping.when
    return when == "after" or (when == "auto" and not is_shown)


def seen_by(former: SavedResult, config: Config) -> InputConfig:
    """How a source is read that the camera of an earlier result took, if nobody says otherwise."""
    known = former.folder / "intrinsics.json"
    if config.input.intrinsics.strip().lower() != "auto" or not known.is_file():
        return config.input
    return replace(config.input, intrinsics=str(known))


def _run(
    settings: RunSettings,
    opened: Stream,
    former: SavedResult | None,
    output: Path,
    device: torch.device,
    progress: RunProgress,
    stop: Stop,
    observer: RunObserver | None,
) -> Written:
    """The same once the source is opened and the folder is ours."""
    config = settings.config
    compiled_kernels(device)
    calibrated = self_calibrated(opened, config, device, progress, stop)
    found = None if calibrated is opened else calibrated.calibration
    prior = open_prior(config.prior, calibrated.camera, device)
    # A system loads much; meanwhile the images tell of the shutter, which does not concern it.
    with ThreadPoolExecutor(1, thread_name_prefix="system") as beside:
        made = beside.submit(
            Slam, calibrated.camera, config, str(device), prior, calibrated.is_live,
            calibrated.mask, calibrated.black_is_masked, maps_at_the_end(settings, observer),
        )  # fmt: skip
        source = with_shutter_found(calibrated, progress, stop)
        slam = made.result()
    if former is not None:
        slam.start_from(former.disks, former.keyframes)
    if former is not None or source.is_live:
        settings = replace(settings, checkpoint_every=0.0)  # neither can be gone on with
    facts = RunFacts(
        settings.absolute(), device.type, source.fingerprint(), found, shutter=source.shutter
    )
    if has_checkpoint(output):
        progress.write(
            f"Starting anew; geogs run --resume {output} would go on with the unfinished run "
            "there, until the first checkpoint of this one."
        )
    prepared = _Run(slam, source, settings, output, facts, progress, stop, observer)
    return prepared.complete(iter(source))


@on_one_torch_thread
@full_memory_in_a_sentence()
def resume(
    output: Path,
    settings: RunSettings | None = None,
    progress: RunProgress | None = None,
    stop: Stop | None = None,
    observer: RunObserver | None = None,
) -> Written:
    """Go on with the run whose checkpoint lies in a folder, as if nothing had happened.

    ``settings`` are those it was begun with if none are given. Given ones may differ in what does
    not decide about poses and map: the mesh, the number of the device, checkpoints, and what is
    written besides.

    Raises:
        InputError: there is nothing to resume, or it cannot be used, or with other settings.
        TrackingLost, OutputError, DeviceError: as of a run.
    """
    progress, stop = progress or RunProgress(), stop or Stop()
    saved = SavedRun(output)
    settings = continued(saved.facts, settings or saved.facts.settings, output)
    config, device = settings.config, require_device(settings.device)
    source = saved.calibrated(open_source(settings.source, config.input))
    output = prepare_output_folder(output)
    with only_writer(output):
        compiled_kernels(device)
        prior = open_prior(config.prior, source.camera, device)
        slam = Slam(
            source.camera, config, str(device), prior, mask=source.mask,
            black_is_masked=source.black_is_masked,
        )  # fmt: skip
        saved.restore(slam)
        progress.write(f"Going on after {slam.frames} frames.")
        facts = replace(saved.facts, settings=settings.absolute(), device=device.type)
        frames = frames_after(source, saved.facts.place)
        prepared = _Run(slam, source, settings, output, facts, progress, stop, observer)
        return prepared.complete(frames)


def continued(facts: RunFacts, settings: RunSettings, output: Path) -> RunSettings:
    """Settings to go on with in a folder, on the kind of device that the run began on or the CPU.

    Raises:
        InputError: they would compute something else, or elsewhere.
    """
    elsewhere = settings.output is not None and settings.output.resolve() != output.resolve()
    if elsewhere or settings.deciding() != facts.settings.deciding():
        raise InputError(
            "--resume goes on with the source and the settings of the run; leave out everything "
            "else but --device, --mesh, --checkpoint-every, --online-results, --depth-mesh, "
            "--keyframe-images and --scale-from."
        )
    device = facts.device if settings.device == "auto" else settings.device
    if not device.startswith(facts.device) and device != "cpu":
        raise InputError(f"The run was on {facts.device}, and can only go on there.")
    return replace(settings, device=device)


@dataclass(frozen=True)
class _Run:
    """A run that has been made ready."""

    slam: Slam
    source: Stream
    settings: RunSettings
    output: Path
    facts: RunFacts
    progress: RunProgress
    stop: Stop
    observer: RunObserver | None = None
    stages: list[str] = field(default_factory=list)
    """Whose results have been written."""

    def complete(self, frames: Generator[Frame, None, None]) -> Written:
        """The frames that are left, the final stages, the files."""
        slam, source, settings, output = self.slam, self.source, self.settings, self.output
        progress = self.progress
        checkpoint = RunCheckpoint(output, self.facts, settings.checkpoint_every, progress)
        progress.plan(
            RunForecast(
                slam.config, slam.stopwatch, source.length, slam.defers_map, self.facts.device
            )
        )
        progress.expect(source.length, slam.frames)
        kept = False
        with full_memory_in_a_sentence(self._way_on), self.stop:
            with closing(frames):
                full = not self._feed(frames, checkpoint)
            if source.is_live and self.stop.requested:  # the usual end of what has none
                self.stop.requested = False
                progress.write("Stopping; finishing the map. Press Ctrl-C to stop that, too.")
            interrupted = full or self.stop.requested
            if interrupted:
                why = "The GPU has no memory left" if full else "Stopping early"
                progress.write(f"{why}; keeping what there is. Press Ctrl-C again to quit.")
                kept = not full and checkpoint.write(slam, source)
            slam.end_stream()
            if not interrupted:
                kept = checkpoint.write(slam, source)
            self._write_stage("online")
            interrupted |= not self._finish(correct=not interrupted)
            make_metric(slam, source, scale_source(settings.scale_from), progress)
            result = Result(slam, source, interrupted, progress)
            more = [lambda: write_depth_mesh(output, slam, progress)]
            more = more if settings.depth_mesh else []
            write_results(output, result, more, settings.keyframe_images, self.stages)
            if self.observer is not None:
                self.observer.result(result)
        if full:
            raise DeviceError(
                f"The memory of the GPU was full after {slam.frames} frames, whose results are in "
                f"{output}/; {REMEDY}.{self._way_on()}"
            )
        if not interrupted:
            checkpoint.remove()
        return Written(output, result, interrupted and kept)

    def _way_on(self) -> str:
        """How to go on after a failure, behind another sentence; nothing if there is no way."""
        if not has_checkpoint(self.output):
            return ""
        on_cpu = ", with --device cpu on the CPU" if self.facts.device != "cpu" else ""
        return f" geogs run --resume {self.output} goes on from the last checkpoint{on_cpu}."

    def _feed(self, frames: Iterator[Frame], checkpoint: RunCheckpoint) -> bool:
        """All frames through the system, until a request to stop; false if the GPU is full."""
        slam = self.slam
        if slam.is_ended:
            next(frames, None)  # only what the source says of itself at its end
            return True
        try:
            for frame in _timed(frames, slam.stopwatch):
                status = slam.process(frame)
                self.progress.frame(status)
                if self.observer is not None:
                    self.observer.frame(frame, status, slam)
                if self.stop.requested:
                    break
                checkpoint.after_frame(slam, self.source)
        except torch.cuda.OutOfMemoryError:
            torch.cuda.empty_cache()
            return False
        return True

    def _finish(self, correct: bool) -> bool:
        """The final stages, if they are to be; false where they were not done to the end."""

        def report(stage: str, fraction: float) -> None:
            self.progress.stage(stage, fraction)
            self.stop.check()

        try:
            if correct and self._adjust_and_refine(report):
                return True
            self.slam.map_briefly(BRIEFLY, self.progress.stage)
        except torch.cuda.OutOfMemoryError:
            torch.cuda.empty_cache()
            self.progress.write(
                "The GPU has no memory left for the final stages; keeping what there is."
            )
        return False

    def _adjust_and_refine(self, report: Progress) -> bool:
        """False if a request to stop cut it short."""
        slam = self.slam
        try:
            slam.adjust(report)
            if slam.will_refine:
                self._write_stage("adjusted")
            slam.refine(report)
        except KeyboardInterrupt:
            if not self.stop.requested:
                raise
            return False
        return True

    def _write_stage(self, name: Literal["online", "adjusted"]) -> None:
        """What there is by now, if it is asked for, and if there is a map."""
        if self.settings.online_results and not self.slam.defers_map:
            write_stage(self.output, self.slam, self.progress, name)
            self.stages.append(name)


def _timed(frames: Iterator[Frame], stopwatch: Stopwatch) -> Iterator[Frame]:
    """The frames; waiting for them is a stage, too."""
    while True:
        with stopwatch("reading"):
            frame = next(frames, None)
        if frame is None:
            return
        yield frame
