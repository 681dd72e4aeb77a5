"""Runs tasks like ``geogs run`` and ``geogs reconstruct``, with the same options."""

import json
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import cast

from geogs.application.calibrate import self_calibrated
from geogs.application.checkpoints.checkpoint import checkpoint_folder, write_checkpoint
from geogs.application.checkpoints.run_state import RunMetadata, SavedRun, run_state
from geogs.application.interrupt import Interruption
from geogs.application.prior_choice import open_prior
from geogs.application.progress.run_progress import RunProgress
from geogs.application.progress.terminal_progress import TerminalProgress
from geogs.application.reconstruct import reconstruct_to_folder
from geogs.application.results.result import Result
from geogs.application.results.summary import state_spans
from geogs.application.results.verdict import verdict
from geogs.application.results.write import write_results
from geogs.application.run import run
from geogs.application.run_settings import ReconstructSettings, RunSettings
from geogs.cli import reconstruct as reconstruct_command
from geogs.cli import run as run_command
from geogs.cli.options import record
from geogs.errors import InputError, TrackingLost
from geogs.gpu.installation import require_device
from geogs.guard.atomic import prepare_output_folder, write_text
from geogs.io.sources.sniff import open_source
from geogs.io.writers.trajectories import write_trajectories
from geogs.io.writers.uncertainty import write_uncertainty
from geogs.loop.global_bundle import global_bundle
from geogs.slam import Slam
from geogs.threads import on_one_torch_thread
from geogs.tracking.frame_uncertainty import frame_uncertainty
from geogs_bench.runners.colour_baseline import require_packages, train_baseline
from geogs_bench.runners.task import Task

_NO_SETTINGS = ("source", "output", "overwrite", "resume", "checkpoint_every")
"""Settings that do not change a result."""
FOLDER = "before"
"""Folder, next to those of the variants, of a map before its correction."""


class Runner:
    """Runs tasks with the code of the two commands, a part of it, or the baseline."""

    def settings(self, task: Task) -> dict[str, object]:
        """Every setting of the command but its output.

        Raises:
            InputError: an option is wrong, or a package of the baseline is not installed.
        """
        if task.command == "colour-2dgs":
            require_packages()
        settings = asdict(settings_of(task))
        settings |= settings.pop("config")
        return {name: value for name, value in settings.items() if name not in _NO_SETTINGS}

    def run(self, task: Task) -> None:
        """Run the command, or its tracking alone; correct one map, saved at the end of the stream,
        by the rule in the options; or train the baseline.

        Raises:
            GeogsError: it failed, with a message.
        """
        settings = replace(settings_of(task), checkpoint_every=0.0)
        if isinstance(settings, RunSettings) and task.command == "track":
            track_to_folder(settings, task.output)
            return
        with TerminalProgress() as progress:
            if task.command == "colour-2dgs":
                train_baseline(cast(ReconstructSettings, settings))
            elif not isinstance(settings, RunSettings):
                reconstruct_to_folder(settings, progress, Interruption())
            elif task.command == "update":
                correct_saved_map(settings, task.output, progress)
            else:
                run(settings, progress, Interruption())


def settings_of(task: Task) -> RunSettings | ReconstructSettings:
    """Settings from a task's options, by the command's own parser."""
    argv = [str(task.source), "-o", str(task.output), "--overwrite"]
    argv += [argument for option in task.options for argument in option.arguments()]
    if task.command in ("run", "track", "update"):
        return record(RunSettings, run_command.parse(argv))
    return record(ReconstructSettings, reconstruct_command.parse(argv))


@on_one_torch_thread
def track_to_folder(settings: RunSettings, output: Path) -> None:
    """Track every frame, close loops, adjust all keyframes; write trajectory and summary.

    A video in which no frame can be tracked leaves a summary with that failure, and no trajectory.

    Raises:
        InputError: the source or a setting cannot be used.
        DeviceError, OutputError: the device, or the folder.
    """
    device = require_device(settings.device)
    source = self_calibrated(
        open_source(settings.source, settings.config.input), settings.config, device
    )
    folder = prepare_output_folder(output)
    slam = Slam(source.image_camera, settings.config, str(device), pinhole=source.camera)
    start = time.perf_counter()
    frames = 0
    for frame in source:
        slam.loops.update(slam.segments.track(frame, slam.loops.recognise), False)
        slam.segments.main.keyframes.take_corrections()
        frames += 1
    seconds = time.perf_counter() - start
    summary = {
        "device": device.type,
        "frames": frames,
        "shutter": asdict(source.shutter),
        "frames_per_second": {"until_stream_end": round(frames / max(seconds, 1e-9), 3)},
    }
    try:
        slam.loops.update(slam.segments.finish(), True)
        global_bundle(slam.segments.main, ends=True)
        trajectory = slam.trajectory()
        known = frame_uncertainty(slam.segments.main)
        write_trajectories(folder, trajectory, slam.keyframe_trajectory())
        write_uncertainty(folder / "trajectory_uncertainty.csv", trajectory, known)
        summary["lost_spans"] = state_spans(trajectory, "lost")
        said = verdict(trajectory, slam.keyframe_trajectory(), known, slam.segments.table.why_not)
        summary["verdict"] = {"is_reliable": said.is_reliable, "sentence": said.sentence}
    except TrackingLost as error:
        summary["not_tracked"] = str(error)
    write_text(folder / "summary.json", json.dumps(summary, indent=2) + "\n")


@on_one_torch_thread
def correct_saved_map(settings: RunSettings, output: Path, progress: RunProgress) -> None:
    """Correct the map at the end of the stream by the settings' rule; write the result.

    The paper saves the map before its final bundle adjustment and corrects that one map by every
    rule.

    The first call in a folder runs the stream and keeps a checkpoint of its end; later calls whose
    settings differ only in the rule start from there.

    Raises:
        InputError: the source or a setting cannot be used, or no map was started.
        OutputError, DeviceError, TrackingLost: as of a run.
    """
    settings = settings.absolute()
    place = output.parent / FOLDER
    saved = _saved(place, settings) or _run_stream(place, settings, progress)
    source = saved.calibrated(open_source(settings.source, settings.config.input))
    device = require_device(settings.device)
    with saved.world(device) as world:
        cameras = source.image_camera, source.camera
        slam = Slam(cameras[0], settings.config, str(device), world=world, pinhole=cameras[1])
    slam.adjust(progress.stage)
    result = Result(slam, source, False, progress)
    write_results(output, result, keyframe_images=False, overwrite=True)


def _saved(place: Path, settings: RunSettings) -> SavedRun | None:
    """The checkpoint of the same stream, if there is one."""
    try:
        saved = SavedRun(place)
    except InputError:
        return None
    same = _without_rule(saved.metadata.settings) == _without_rule(settings)
    return saved if same else None


def _run_stream(place: Path, settings: RunSettings, progress: RunProgress) -> SavedRun:
    """Track and map up to the end of the stream, and save a checkpoint."""
    config = settings.config
    device = require_device(settings.device)
    source = self_calibrated(open_source(settings.source, config.input), config, device)
    prior = open_prior(config.prior, source.camera, device)
    slam = Slam(source.image_camera, config, str(device), prior, pinhole=source.camera)
    metadata = RunMetadata(
        settings, device.type, source.fingerprint(), source.calibration, shutter=source.shutter
    )
    progress.expect(source.length)
    for frame in source:
        progress.frame(slam.process(frame))
    slam.end_stream()
    state = run_state(metadata, slam, source)
    if state is None:
        raise InputError("no map was started; there is nothing to correct.")
    write_checkpoint(checkpoint_folder(prepare_output_folder(place)), state)
    return SavedRun(place)


def _without_rule(settings: RunSettings) -> RunSettings:
    """The settings that determine the map before its correction."""
    config = settings.deciding().config
    ablation = replace(config.mapping.ablation, map_update="coherent")
    mapping = replace(config.mapping, ablation=ablation)
    return replace(settings.deciding(), config=replace(config, mapping=mapping))
